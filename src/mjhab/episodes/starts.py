"""From an episode to the state and plan a world starts with."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.core.errors import MjhabError, UsageError, unknown_name
from mjhab.core.seeding import stream
from mjhab.episodes.generator import Episode
from mjhab.episodes.grasps.held import HeldStarts
from mjhab.episodes.grasps.held_arms import HeldArms
from mjhab.episodes.spawn_sets import SpawnSet
from mjhab.episodes.spawns import (
    MAX_TRIES,
    TELEPORT_DISTANCE,
    TELEPORT_YAW_NOISE,
    Held,
    SpawnGoal,
    SpawnSampler,
)
from mjhab.layout.layout import Layout
from mjhab.scenes.roles import FRIDGE_DOOR_LINK, KITCHEN_DRAWER_LINK, link_with_role
from mjhab.scenes.spec import Home
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import parked_robot_qpos
from mjhab.tasks.plan import (
    FRONT_AREAS,
    Box,
    Subtask,
    SubtaskKind,
    TaskConfig,
    TaskPlan,
    chain,
    front_box,
)

TURN_SPARE = 0.02
"""By how much [rad] a teleport must face its goal better than success asks for: its noise is clipped at that very angle
(`spawns.YAW_NOISE`), and one teleport in twenty would end there, fail by a rounding error and stay so to the end."""
OPEN_START_MARGIN = 1.0
"""Opened links start between their success fraction and this fraction of their range."""

ROAM_RADIUS = 0.5
"""Room [m] around the place where the robot of a chain begins."""

AJAR = 0.2
"""Part of the way to open at which a drawer starts that was left ajar (mshab/envs/open.py)."""

DOORSTEP = (-1.0, 0.0)
DOORSTEP_REACH = 0.5
DOORSTEP_YAW = (-np.pi / 2, np.pi / 2)
"""Where the first Navigate of PrepareGroceries begins, how near to it, and heading [m, rad]
(mshab/utils/gen/gen_spawn_positions.py, in ReplicaCAD's apartment)."""


@dataclass(frozen=True, eq=False)
class Start:
    """How a world begins: its plan, its state (nq,), whether the first robot pose was a fallback.

    ``position`` of the subtask in the episode's chain, 0 for a whole chain; ``tries`` it took to place the robot.
    """

    plan: TaskPlan
    home: str
    qpos: np.ndarray
    boxes: dict[str, Box]
    fallback: bool
    position: int = 0
    tries: int = 1


def subtask_positions(plan: TaskPlan, layout: Layout, kind: str, target: str) -> list[int]:
    """Positions in a plan of the subtasks of a kind about a target (object type, object name, link; "" for any)."""

    def matches(subtask: Subtask) -> bool:
        about = subtask.obj if kind in ("pick", "place", "navigate") else subtask.link
        return not target or about == target or about.split("_:")[0] == target

    wanted = SubtaskKind[kind.upper()]
    return [i for i, s in enumerate(plan.subtasks) if s.kind == wanted and matches(s)]


def valid_targets(config: EnvConfig, layout: Layout) -> list[str]:
    """Object types or links that the task's subtask can be about."""
    if config.subtask in ("open", "close"):
        roles = layout.pack.roles
        return [link_with_role(roles, name) for name in (KITCHEN_DRAWER_LINK, FRIDGE_DOOR_LINK)]
    if config.task == "set_table":
        return ["024_bowl", "013_apple"]
    return sorted(set(layout.roster))


def check_target(config: EnvConfig, layout: Layout) -> None:
    """Raise a UsageError when ``config.target`` names nothing that the task's subtask can be about."""
    if not config.target:
        return
    valid = valid_targets(config, layout)
    if config.target not in valid:
        raise unknown_name("target", config.target, valid)
    if not config.subtask:
        raise UsageError(
            f"target {config.target!r} needs a subtask: add --subtask pick, place, open or close."
        )


class StartMaker:
    """Builds starts of whole chains and of single subtasks.

    Args:
        sim: whose homes are used. config, task_config: what is to be done.
        harvested: place with the grasps, too, that were added to `held`; not under the published spawn rule.

    Raises:
        UsageError: ``harvested`` under the published spawn rule; a file of starts that does not fit.
    """

    def __init__(
        self, sim: CpuSimulator, config: EnvConfig, task_config: TaskConfig, harvested: bool = False
    ) -> None:
        self.sim = sim
        self.config = config
        self.task_config = task_config
        self.layout = sim.layout
        self.sampler = SpawnSampler(sim)
        self.held = HeldStarts(sim, task_config, self.sampler.scratch, harvested)
        self.published = config.spawn_rule == "published"
        if self.published and harvested:
            raise UsageError("the published spawn rule has arms of its own; leave out harvested.")
        self.arms = HeldArms(self.held)
        self.spawn_set = SpawnSet.load(Path(config.spawns), self.layout) if config.spawns else None
        if self.spawn_set is not None:
            self.spawn_set.check(config)
        self._homes = {home.name: home for home in self.layout.pack.homes}
        self._boxes: dict[str, dict[str, Box]] = {}

    def start(self, episode: Episode) -> Start:
        """The start of an episode under this configuration; random draws are named by (seed, index).

        With ``config.spawns`` it is the one of that file for the episode's index.
        """
        home = self._homes[episode.home]
        boxes = self.boxes(home)
        plan = chain(episode.task, episode.targets, home.name)
        if self.spawn_set is not None:
            row = self.spawn_set.row(episode.index)
            own = plan.only(row.position) if self.config.subtask else plan
            return Start(own, home.name, row.qpos, boxes, row.fallback, row.position, row.tries)
        qpos = self._episode_qpos(episode)
        if not self.config.subtask:
            qpos, fallback, tries = self._roam(episode, qpos)
            return Start(plan, home.name, qpos, boxes, fallback, tries=tries)
        position = self._pick_position(plan, episode)
        rng = stream(episode.seed, "start", episode.task, episode.index)
        held = self._prepare(rng, episode, plan, position, qpos)
        goal = self._goal(episode, plan, position, boxes, qpos)
        if self.published:
            goal = dataclasses.replace(goal, slack=np.inf, published=True)
        qpos, fallback, tries = self._spawn(episode, qpos, goal, held)
        return Start(plan.only(position), home.name, qpos, boxes, fallback, position, tries)

    def starts(self, episodes: Sequence[Episode], threads: int = 1) -> list[Start]:
        """The starts of several episodes, the same for any number of ``threads``.

        One thread makes a thousand in a second, and half of that time is Python: more hardly help.
        """
        if threads <= 1:
            return [self.start(episode) for episode in episodes]
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(self.start, episodes))

    def home(self, name: str) -> Home:
        """The home of a name."""
        return self._homes[name]

    def boxes(self, home: Home) -> dict[str, Box]:
        """Area in front of every link of a home, as (x_min, x_max, y_min, y_max)."""
        if home.name not in self._boxes:
            self._boxes[home.name] = {
                ref.id: front_box(
                    ref.id,
                    self._link_root(home, ref.id),
                    self.layout.articulation_placement(home, ref.articulation).yaw,
                )
                for ref in self.layout.links
                if ref.articulation in FRONT_AREAS
            }
        return self._boxes[home.name]

    def _link_root(self, home: Home, link: str) -> tuple[float, float]:
        """Where the original measures from: the origin of the fridge, or of the closed drawer's link [m]."""
        furniture = link.split("/")[0]
        if furniture == "fridge":
            x, y, _ = self.layout.articulation_placement(home, furniture).pos
        else:
            x, y, _ = self.layout.closed_link_origin(home, link)
        return (x, y)

    def spawn_goal(self, plan: TaskPlan, position: int, boxes: dict[str, Box]) -> SpawnGoal:
        """Where a robot stands that has navigated to the subtask at ``position`` of a plan, or does so now."""
        subtask = plan.subtasks[position]
        if subtask.kind == SubtaskKind.PICK:
            point = next(
                s.goal_pos for s in plan.subtasks[:position][::-1] if s.kind == SubtaskKind.NAVIGATE
            )
        else:
            point = subtask.goal_pos
        area = np.array(boxes[subtask.link]) if subtask.link else None
        navigated = subtask.kind == SubtaskKind.NAVIGATE
        turn = self.task_config.nav_bearing - TURN_SPARE if navigated else np.pi
        goal = SpawnGoal(np.array(point[:2]), area, turn=turn)
        if not (self.published and navigated):
            return goal
        # The front area binds only where the Navigate is judged by it. A teleport must end where that is achieved.
        judged = None if subtask.must_hold else area
        return dataclasses.replace(
            goal,
            area=judged,
            reach=TELEPORT_DISTANCE,
            yaw_noise=TELEPORT_YAW_NOISE,
            slack=self.task_config.nav_distance - TELEPORT_DISTANCE if judged is None else 0.0,
            published=True,
        )

    def foresee(self, episode: Episode, plan: TaskPlan, position: int) -> np.ndarray:
        """State (nq,) in which a chain comes to the Navigate at ``position`` if all before went well, the robot parked.

        What the robot carries then is out of the way.
        """
        qpos = self._episode_qpos(episode)
        slots = self.layout.object_names
        for subtask in plan.subtasks[:position]:
            if subtask.kind == SubtaskKind.PLACE:
                self._put_at_goal(qpos, slots.index(subtask.obj), subtask.goal_pos)
        link, placed = _open_before(plan, position)
        if link:
            rng = stream(episode.seed, "foresee", episode.task, episode.index, position)
            self._leave_open(rng, episode, link, qpos, placed)
        if plan.subtasks[position].must_hold:
            slot = slots.index(plan.subtasks[position].obj)
            start = self.sim.addresses.object_q[slot]
            qpos[start : start + 7] = self.layout.parked_poses[slot]
        return qpos

    # -- single subtasks -------------------------------------------------------------------------------------------

    def _pick_position(self, plan: TaskPlan, episode: Episode) -> int:
        found = subtask_positions(plan, self.layout, self.config.subtask, self.config.target)
        if not found:
            raise UsageError(
                f"no {self.config.subtask} of {self.config.target!r} in task {self.config.task!r}"
            )
        first = int(stream(episode.seed, "subtask", episode.index).integers(len(found)))
        # A narrow hand cannot hold everything: then it is the turn of the next object.
        for position in (*found[first:], *found[:first]):
            if self._holdable(plan.subtasks[position]):
                return position
        raise MjhabError(
            f"robot {self.layout.robot.name!r} cannot hold any object of episode {episode.index} of {episode.task}"
        )

    def _holdable(self, subtask: Subtask) -> bool:
        """Whether the hand can hold what a subtask begins with in it."""
        if subtask.kind != SubtaskKind.PLACE and not subtask.must_hold:
            return True
        slot = self.layout.object_names.index(subtask.obj)
        return self.held.holds(self.layout.roster[slot])

    def _episode_qpos(self, episode: Episode) -> np.ndarray:
        a = self.sim.addresses
        qpos = self.sim.model(episode.home).qpos0.copy()
        qpos[a.robot_q] = parked_robot_qpos(self.layout.robot)
        qpos[a.object_q[:, None] + np.arange(7)] = episode.object_pose
        qpos[a.link_q] = episode.link_q
        return qpos

    def _goal(
        self,
        episode: Episode,
        plan: TaskPlan,
        position: int,
        boxes: dict[str, Box],
        qpos: np.ndarray,
    ) -> SpawnGoal:
        """Where the robot stands to start the subtask at ``position`` alone, in a home in the state ``qpos`` (nq,).

        Open is faced by the object inside, Close by the furniture, as in mshab/utils/gen/gen_spawn_positions.py.
        """
        subtask = plan.subtasks[position]
        if subtask.kind == SubtaskKind.NAVIGATE:
            return self._departure(episode, plan, position)
        if self.published and subtask.kind == SubtaskKind.PICK:
            start = self.sim.addresses.object_q[self.layout.object_names.index(subtask.obj)]
            return SpawnGoal(qpos[start : start + 2])
        if self.published and subtask.kind == SubtaskKind.PLACE:
            return SpawnGoal(np.array(subtask.goal_pos[:2]))
        goal = self.spawn_goal(plan, position, boxes)
        if subtask.kind == SubtaskKind.OPEN:
            inside = next(t.start_pos for t in episode.targets if t.obj == subtask.obj)
            return SpawnGoal(np.array(inside[:2]), goal.area)
        if subtask.kind == SubtaskKind.CLOSE:
            return SpawnGoal(
                np.array(self._link_root(self._homes[episode.home], subtask.link)), goal.area
            )
        return goal

    def _departure(self, episode: Episode, plan: TaskPlan, position: int) -> SpawnGoal:
        """Where a Navigate alone begins: anywhere; in PrepareGroceries where the one before it led to.

        Its first one begins at the original's doorstep, or in a home that has no floor there, where there is most room.
        """
        if episode.task != "prepare_groceries":
            return SpawnGoal(None)
        before = [
            s.goal_pos
            for s in plan.subtasks[:position]
            if s.kind in (SubtaskKind.NAVIGATE, SubtaskKind.PLACE)
        ]
        if before:
            return SpawnGoal(np.array(before[-1][:2]))
        at = SpawnGoal(None, near=np.array(DOORSTEP), reach=DOORSTEP_REACH, yaw=DOORSTEP_YAW)
        if not at.allows(self.sampler.walkable(episode.home)).any():
            at = SpawnGoal(
                None,
                near=self.sampler.roomiest(episode.home),
                reach=DOORSTEP_REACH,
                yaw=DOORSTEP_YAW,
            )
        return at

    def _prepare(
        self,
        rng: np.random.Generator,
        episode: Episode,
        plan: TaskPlan,
        position: int,
        qpos: np.ndarray,
    ) -> Held | None:
        """Bring the home into the state in which the subtask comes up; returns what the robot holds."""
        subtask = plan.subtasks[position]
        if subtask.kind == SubtaskKind.PICK and subtask.link:
            self._ensure_open(rng, episode, subtask.link, qpos, anew=episode.task == "set_table")
            self._carry_along(episode, subtask, qpos)
        elif subtask.kind == SubtaskKind.CLOSE:
            self._leave_open(rng, episode, subtask.link, qpos, placed=True)
        elif subtask.kind == SubtaskKind.OPEN:
            self._leave_ajar(rng, episode, subtask, qpos)
        elif subtask.kind == SubtaskKind.NAVIGATE:
            link, placed = _open_before(plan, position)
            if link:
                self._leave_open(rng, episode, link, qpos, placed)
        if subtask.kind == SubtaskKind.PLACE or (
            subtask.kind == SubtaskKind.NAVIGATE and subtask.must_hold
        ):
            if subtask.link:
                self._ensure_open(rng, episode, subtask.link, qpos)
            return self._hold(rng, subtask, qpos)
        return None

    def _link_q(self, link: str) -> int:
        return int(self.sim.addresses.link_q[self.layout.link_ids.index(link)])

    def _open_link(self, rng: np.random.Generator, home: str, link: str, qpos: np.ndarray) -> None:
        low, high = self.layout.links[self.layout.link_ids.index(link)].link.range
        fraction = rng.uniform(self.task_config.open_fraction(link), OPEN_START_MARGIN)
        at = low + fraction * (high - low)
        qpos[self._link_q(link)] = min(at, dict(self._homes[home].open_limits).get(link, at))

    def _ensure_open(
        self,
        rng: np.random.Generator,
        episode: Episode,
        link: str,
        qpos: np.ndarray,
        anew: bool = False,
    ) -> None:
        """Open a link that stands less than half open, or draw ``anew`` how far it is open."""
        low, high = self.layout.links[self.layout.link_ids.index(link)].link.range
        half_open = low + 0.5 * self.task_config.open_fraction(link) * (high - low)
        if anew or qpos[self._link_q(link)] < half_open:
            self._open_link(rng, episode.home, link, qpos)

    def _leave_open(
        self, rng: np.random.Generator, episode: Episode, link: str, qpos: np.ndarray, placed: bool
    ) -> None:
        """Open a link as its Open has left it; what was inside is still there, or ``placed`` at its goal."""
        self._open_link(rng, episode.home, link, qpos)
        target = next(t for t in episode.targets if t.start_link == link)
        if placed:
            self._put_at_goal(qpos, self.layout.object_names.index(target.obj), target.goal_pos)
        else:
            self._carry_along(episode, Subtask(SubtaskKind.PICK, obj=target.obj, link=link), qpos)

    def _leave_ajar(
        self, rng: np.random.Generator, episode: Episode, subtask: Subtask, qpos: np.ndarray
    ) -> None:
        """In training, let a drawer start part of the way to open now and then (mshab/envs/open.py)."""
        ref = self.layout.links[self.layout.link_ids.index(subtask.link)]
        if ref.link.joint != "slide" or rng.uniform() >= self.config.open_start:
            return
        low, high = ref.link.range
        qpos[self._link_q(subtask.link)] = low + AJAR * self.task_config.open_fraction(
            subtask.link
        ) * (high - low)
        self._carry_along(episode, subtask, qpos)

    def _carry_along(self, episode: Episode, subtask: Subtask, qpos: np.ndarray) -> None:
        """An object in a drawer moves with it (mshab/utils/gen/gen_spawn_positions.py)."""
        ref = self.layout.links[self.layout.link_ids.index(subtask.link)]
        if ref.link.joint != "slide":
            return
        yaw = self.layout.articulation_placement(self._homes[episode.home], ref.articulation).yaw
        start = self.sim.addresses.object_q[self.layout.object_names.index(subtask.obj)]
        moved = (
            qpos[self._link_q(subtask.link)]
            - episode.link_q[self.layout.link_ids.index(subtask.link)]
        )
        ax, ay, _ = ref.link.axis
        direction = np.array(
            [np.cos(yaw) * ax - np.sin(yaw) * ay, np.sin(yaw) * ax + np.cos(yaw) * ay]
        )
        qpos[start : start + 2] += moved * direction

    def _put_at_goal(self, qpos: np.ndarray, slot: int, goal: tuple[float, float, float]) -> None:
        start = self.sim.addresses.object_q[slot]
        qpos[start : start + 3] = goal
        qpos[start + 2] += 0.001

    def _hold(self, rng: np.random.Generator, subtask: Subtask, qpos: np.ndarray) -> Held:
        slot = self.layout.object_names.index(subtask.obj)
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

    # -- where the robot stands ------------------------------------------------------------------------------------

    def _spawn(
        self, episode: Episode, qpos: np.ndarray, goal: SpawnGoal, held: Held | None
    ) -> tuple[np.ndarray, bool, int]:
        """The state (nq,) with the robot in it, whether it stands there for want of a better place, and the tries."""
        name = ("spawn", episode.task, episode.index)
        rngs = (stream(episode.seed, *name, attempt) for attempt in range(MAX_TRIES))
        found, tries = self.sampler.search(episode.home, qpos, goal, rngs, held)
        if found is None:
            return self.sampler.fallback(episode.home, qpos, goal, held), True, tries
        return found, False, tries

    def _roam(self, episode: Episode, qpos: np.ndarray) -> tuple[np.ndarray, bool, int]:
        """A chain begins with the robot somewhere in the home; its first Navigate brings it to work."""
        rng = stream(episode.seed, "roam", episode.task, episode.index)
        cells = self.sampler.walkable(episode.home, ROAM_RADIUS)
        for attempt in range(MAX_TRIES):
            xy = cells[int(rng.integers(len(cells)))]
            heading = rng.uniform(-np.pi, np.pi)
            face = xy + np.array([np.cos(heading), np.sin(heading)])
            found = self.sampler.at(episode.home, qpos, xy, SpawnGoal(face))
            if found is not None:
                return found, False, attempt + 1
        return self.sampler.fallback(episode.home, qpos, SpawnGoal(cells[0])), True, MAX_TRIES


def _open_before(plan: TaskPlan, position: int) -> tuple[str, bool]:
    """The link that a plan has left open before ``position``, or "", and whether what was inside is placed by then."""
    link = ""
    placed = False
    for subtask in plan.subtasks[:position]:
        if subtask.kind == SubtaskKind.OPEN:
            link = subtask.link
            placed = False
        elif subtask.kind == SubtaskKind.PLACE:
            placed = True
        elif subtask.kind == SubtaskKind.CLOSE:
            link = ""
    return link, placed
