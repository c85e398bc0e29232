"""What brings a home into the state in which a subtask comes up: joints, objects, what the robot holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.core.arrays import Array
from mjhab.episodes.generator import Episode
from mjhab.episodes.grasps.carry_postures import CarryPostures
from mjhab.episodes.grasps.stable import StableGrasps
from mjhab.episodes.spawns import Held, SpawnSampler
from mjhab.layout.layout import Layout, LinkRef
from mjhab.scenes.spec import Home
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.plan import Vec3
from mjhab.tasks.thresholds import TaskConfig

OPEN_START_MARGIN = 1.0
"""Opened links start between their success fraction and this fraction of their range."""
GOAL_DROP_M = 0.001
"""An object that is put at its goal is let go so high above it."""


@dataclass(frozen=True, eq=False)
class HomeState:
    """Changes states ``qpos`` (nq,) of homes in place. Threads may share it.

    config, task_config: what is to be done. sim: whose homes are used. sampler: where robots fit. held, arms: grasps
    and arm poses with which robots hold objects. homes: by name.
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
        """Names and order of objects, links and homes."""
        return self.sim.layout

    @property
    def published(self) -> bool:
        """Robots start by the rules of the original, see `Profile.spawn_rule`."""
        return self.config.spawn_rule == "published"

    # -- links -----------------------------------------------------------------------------------------------------

    def link(self, link: str) -> LinkRef:
        """A drawer or door of the layout."""
        return self.layout.links[self.layout.link_ids.index(link)]

    def link_address(self, link: str) -> int:
        """Where the joint of a link is in ``qpos``."""
        return int(self.sim.addresses.link_q[self.layout.link_ids.index(link)])

    def open_at(self, link: str) -> float:
        """Part of its range at which a drawer or door counts as open."""
        return self.task_config.open_fraction(hinged=link in self.layout.doors)

    def open_link(self, rng: np.random.Generator, home: str, link: str, qpos: Array) -> None:
        """Open a link so far that an Open would have succeeded, or further."""
        low, high = self.link(link).link.range
        fraction = rng.uniform(self.open_at(link), OPEN_START_MARGIN)
        at = low + fraction * (high - low)
        qpos[self.link_address(link)] = min(at, dict(self.homes[home].open_limits).get(link, at))

    def ensure_open(
        self, rng: np.random.Generator, home: str, link: str, qpos: Array, *, anew: bool = False
    ) -> None:
        """Open a link that stands less than half open, or draw ``anew`` how far it is open."""
        low, high = self.link(link).link.range
        half_open = low + 0.5 * self.open_at(link) * (high - low)
        if anew or qpos[self.link_address(link)] < half_open:
            self.open_link(rng, home, link, qpos)

    def leave_open(
        self, rng: np.random.Generator, episode: Episode, link: str, qpos: Array, *, placed: bool
    ) -> None:
        """Open a link as its Open has left it; the object it was opened for is still there, or ``placed``."""
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
        """Where the pose (7,) of an object begins in ``qpos``."""
        return int(self.sim.addresses.object_q[self.layout.object_names.index(obj)])

    def carry_along(self, episode: Episode, obj: str, link: str, qpos: Array) -> None:
        """An object in a drawer moves with it (mshab/utils/gen/gen_spawn_positions.py)."""
        ref = self.link(link)
        if ref.link.joint != "slide":
            return
        yaw = self.layout.articulation_placement(self.homes[episode.home], ref.articulation).yaw
        start = self.object_address(obj)
        before = episode.link_q[self.layout.link_ids.index(link)]
        moved = qpos[self.link_address(link)] - before
        ax, ay, _ = ref.link.axis
        direction = np.array(
            [np.cos(yaw) * ax - np.sin(yaw) * ay, np.sin(yaw) * ax + np.cos(yaw) * ay]
        )
        qpos[start : start + 2] += moved * direction

    def put_at_goal(self, qpos: Array, obj: str, goal: Vec3) -> None:
        """Move an object to its goal [m, world]."""
        start = self.object_address(obj)
        qpos[start : start + 3] = goal
        qpos[start + 2] += GOAL_DROP_M

    def park(self, qpos: Array, obj: str) -> None:
        """Move an object out of the way."""
        start = self.object_address(obj)
        qpos[start : start + 7] = self.layout.parked_poses[self.layout.object_names.index(obj)]

    def hold(self, rng: np.random.Generator, obj: str, qpos: Array) -> Held:
        """Draw the arm and the grasp with which the robot holds an object."""
        slot = self.layout.object_names.index(obj)
        kind = self.layout.roster[slot]
        robot = self.layout.robot.rest.copy()
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
        return Held(slot, grasp.pose, (self.task_config.grasp_force, self.task_config.grasp_angle))
