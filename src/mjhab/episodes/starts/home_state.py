"""Change the state of a home to that in which a subtask starts: links, objects, the object in the gripper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.core.arrays import Array
from mjhab.episodes.episode import Episode
from mjhab.episodes.grasps.carry_postures import CarryPostures
from mjhab.episodes.grasps.stable import StableGrasps
from mjhab.episodes.spawns import Held, SpawnSampler
from mjhab.layout.layout import Layout, LinkRef
from mjhab.scenes.spec import Home
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.plan import Vec3
from mjhab.tasks.thresholds import TaskConfig

OPEN_START_MARGIN = 1.0
"""Opened links start between the fraction of their range that counts as open and this fraction."""
GOAL_DROP_M = 0.001
"""Height [m] above the goal at which an object is put there."""


@dataclass(frozen=True, eq=False)
class HomeState:
    """Functions that change states ``qpos`` (nq,) of homes in place. Several threads may use it.

    Attributes:
        config: configuration of the environment.
        task_config: thresholds of success.
        sim: CPU simulator of the layout.
        sampler: samples spawns.
        held: stable grasps of the object types.
        arms: arm postures with grasps, for the published spawn rule.
        homes: homes by name.
    """

    config: EnvConfig
    task_config: TaskConfig
    sim: CpuSimulator
    sampler: SpawnSampler
    held: StableGrasps
    arms: CarryPostures
    homes: Mapping[str, Home]

    @property
    def layout(self) -> Layout:
        """Layout of the simulator."""
        return self.sim.layout

    @property
    def published(self) -> bool:
        """Whether robots spawn by the published rule of MS-HAB, see `Profile.spawn_rule`."""
        return self.config.spawn_rule == "published"

    # -- links -----------------------------------------------------------------------------------------------------

    def link(self, link: str) -> LinkRef:
        """Return a moving link of the layout by id."""
        return self.layout.links[self.layout.link_ids.index(link)]

    def link_address(self, link: str) -> int:
        """Return the column of a link's joint in ``qpos``."""
        return int(self.sim.addresses.link_q[self.layout.link_ids.index(link)])

    def open_at(self, link: str) -> float:
        """Return the fraction of its joint range at which a link counts as open."""
        return self.task_config.open_fraction(hinged=link in self.layout.doors)

    def open_link(
        self, rng: np.random.Generator, home: str, link: str, qpos: Array
    ) -> None:
        """Set a link to a random opening at which an Open has succeeded, within the limits of the home."""
        low, high = self.link(link).link.range
        fraction = rng.uniform(self.open_at(link), OPEN_START_MARGIN)
        at = low + fraction * (high - low)
        qpos[self.link_address(link)] = min(
            # A wall may stop a door before the end of its range.
            at,
            dict(self.homes[home].open_limits).get(link, at),
        )

    def ensure_open(
        self,
        rng: np.random.Generator,
        home: str,
        link: str,
        qpos: Array,
        *,
        anew: bool = False,
    ) -> None:
        """Open a link as `open_link` does if it is open by less than half of that, or in any case if ``anew``."""
        low, high = self.link(link).link.range
        half_open = low + 0.5 * self.open_at(link) * (high - low)
        if anew or qpos[self.link_address(link)] < half_open:
            self.open_link(rng, home, link, qpos)

    def leave_open(
        self,
        rng: np.random.Generator,
        episode: Episode,
        link: str,
        qpos: Array,
        *,
        placed: bool,
    ) -> None:
        """Open a link, and put the object that it was opened for where it then is.

        Args:
            rng: draws the opening.
            episode: names the objects.
            link: id of the link.
            qpos: (nq,) state to change.
            placed: the object is at its goal; False: it is still in place, and moves with a drawer.
        """
        self.open_link(rng, episode.home, link, qpos)
        inside = [target for target in episode.targets if target.start_link == link]
        bound = [target for target in episode.targets if target.goal_link == link]
        target = (inside or bound)[0]
        if placed:
            self.put_at_goal(qpos, target.obj, target.goal_pos)
        elif inside:
            self.carry_along(episode, target.obj, link, qpos)

    # -- objects ---------------------------------------------------------------------------------------------------

    def object_address(self, obj: str) -> int:
        """Return the first of the 7 columns of an object's pose in ``qpos``."""
        return int(self.sim.addresses.object_q[self.layout.object_names.index(obj)])

    def carry_along(self, episode: Episode, obj: str, link: str, qpos: Array) -> None:
        """Move an object along with its drawer (mshab/utils/gen/gen_spawn_positions.py); no-op for doors."""
        ref = self.link(link)
        # Objects behind a door stand on shelves, which do not move.
        if ref.link.joint != "slide":
            return
        yaw = self.layout.articulation_placement(
            self.homes[episode.home], ref.articulation
        ).yaw
        start = self.object_address(obj)
        before = episode.link_q[self.layout.link_ids.index(link)]
        moved = qpos[self.link_address(link)] - before
        # Drawers slide level, and furniture turns about the vertical only.
        ax, ay, _ = ref.link.axis
        direction = np.array(
            [np.cos(yaw) * ax - np.sin(yaw) * ay, np.sin(yaw) * ax + np.cos(yaw) * ay]
        )
        qpos[start : start + 2] += moved * direction

    def put_at_goal(self, qpos: Array, obj: str, goal: Vec3) -> None:
        """Move an object to GOAL_DROP_M above its goal [m, world frame]; its orientation stays."""
        start = self.object_address(obj)
        qpos[start : start + 3] = goal
        # In contact with the surface at once, the object could start inside of it.
        qpos[start + 2] += GOAL_DROP_M

    def park(self, qpos: Array, obj: str) -> None:
        """Move an object to its parked pose."""
        start = self.object_address(obj)
        qpos[start : start + 7] = self.layout.parked_poses[
            self.layout.object_names.index(obj)
        ]

    def hold(self, rng: np.random.Generator, obj: str, qpos: Array) -> Held:
        """Draw a grasp of an object, set the arm and fingers in ``qpos`` to it, and return the held object."""
        slot = self.layout.object_names.index(obj)
        kind = self.layout.roster[slot]
        robot = self.layout.robot.rest.copy()
        # The published rule takes whole arm postures from successful Picks.
        if self.published:
            arms = self.arms.arms(kind)
            chosen = arms[int(rng.integers(len(arms)))]
            robot[list(self.layout.robot.arm_columns)] = chosen.arm
            grasp = chosen.grasp
        else:
            grasps = self.held.grasps(kind)
            grasp = grasps[int(rng.integers(len(grasps)))]
        robot[self.layout.robot.columns.fingers] = grasp.fingers
        qpos[self.sim.addresses.robot_q] = robot
        return Held(
            slot, grasp.pose, (self.task_config.grasp_force, self.task_config.grasp_angle)
        )
