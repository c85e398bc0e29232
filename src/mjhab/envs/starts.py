"""From an episode to the state and plan a world starts with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.seeding import stream
from mjhab.envs.config import EnvConfig
from mjhab.envs.episodes import BOWL_DRAWER, FRIDGE_DOOR, Episode
from mjhab.envs.held import HeldStarts
from mjhab.envs.spawns import MAX_TRIES, Held, SpawnGoal, SpawnSampler
from mjhab.scenes.fetch import REST_QPOS
from mjhab.scenes.layout import Layout
from mjhab.scenes.spec import Home
from mjhab.sim.cpu import CpuSimulator
from mjhab.sim.settle import parked_robot_qpos
from mjhab.tasks.plan import Box, Subtask, SubtaskKind, TaskConfig, TaskPlan, chain, front_box

OPEN_START_MARGIN = 1.0
"""Opened links start between their success fraction and this fraction of their range."""

AJAR = 0.2
"""Part of the way to open at which a drawer starts that was left ajar (mshab/envs/open.py)."""


@dataclass(frozen=True, eq=False)
class Start:
    """How a world begins: its plan, its state (nq,), whether the first robot pose was a fallback."""

    plan: TaskPlan
    home: str
    qpos: np.ndarray
    boxes: dict[str, Box]
    fallback: bool


def subtask_positions(plan: TaskPlan, layout: Layout, kind: str, target: str) -> list[int]:
    """Positions in a plan of the subtasks of a kind about a target (object type, object name, link; "" for any)."""

    def matches(subtask: Subtask) -> bool:
        about = subtask.obj if kind in ("pick", "place", "navigate") else subtask.link
        return not target or about == target or about.split("_:")[0] == target

    wanted = SubtaskKind[kind.upper()]
    return [i for i, s in enumerate(plan.subtasks) if s.kind == wanted and matches(s)]


def check_target(config: EnvConfig, layout: Layout) -> None:
    """Raise a UsageError when ``config.target`` names nothing that the task's subtask can be about."""
    if not config.target:
        return
    if config.subtask in ("open", "close"):
        valid = [BOWL_DRAWER, FRIDGE_DOOR]
    elif config.task == "set_table":
        valid = ["024_bowl", "013_apple"]
    else:
        valid = sorted(set(layout.roster))
    if config.target not in valid:
        raise unknown_name("target", config.target, valid)
    if not config.subtask:
        raise UsageError(f"target {config.target!r} needs a subtask: add --subtask pick, place, open or close.")


class StartMaker:
    """Builds starts of whole chains and of single subtasks."""

    def __init__(self, sim: CpuSimulator, config: EnvConfig, task_config: TaskConfig) -> None:
        self.sim, self.config, self.task_config = sim, config, task_config
        self.layout = sim.layout
        self.sampler = SpawnSampler(sim)
        self.held = HeldStarts(sim, task_config, self.sampler.scratch)
        self._homes = {home.name: home for home in self.layout.pack.homes}

    def start(self, episode: Episode) -> Start:
        """The start of an episode under this configuration; random draws are named by (seed, index)."""
        home = self._homes[episode.home]
        plan = chain(episode.task, episode.targets, home.name)
        qpos = self._episode_qpos(episode)
        boxes = self.boxes(home)
        if not self.config.subtask:
            qpos, fallback = self._roam(episode, qpos)
            return Start(plan, home.name, qpos, boxes, fallback)
        position = self._pick_position(plan, episode)
        subtask = plan.subtasks[position]
        rng = stream(episode.seed, "start", episode.task, episode.index)
        held = self._prepare(rng, episode, subtask, qpos)
        goal = self.spawn_goal(plan, position, boxes)
        qpos, fallback = self._spawn(episode, home.name, qpos, goal, held)
        return Start(plan.only(position), home.name, qpos, boxes, fallback)

    def home(self, name: str) -> Home:
        """The home of a name."""
        return self._homes[name]

    def boxes(self, home: Home) -> dict[str, Box]:
        """Area in front of every link of a home, as (x_min, x_max, y_min, y_max)."""
        out = {}
        for ref in self.layout.links:
            at = self.layout.articulation_placement(home, ref.articulation)
            x, y, _ = at.pos if ref.articulation == "fridge" else self.layout.closed_link_origin(home, ref.id)
            out[ref.id] = front_box(ref.id, (x, y), at.yaw)
        return out

    def spawn_goal(self, plan: TaskPlan, position: int, boxes: dict[str, Box]) -> SpawnGoal:
        """Where a robot stands to start the subtask at ``position`` of a plan."""
        subtask = plan.subtasks[position]
        if subtask.kind == SubtaskKind.PICK:
            point = next(s.goal_pos for s in plan.subtasks[:position][::-1] if s.kind == SubtaskKind.NAVIGATE)
        else:
            point = subtask.goal_pos
        area = np.array(boxes[subtask.link]) if subtask.link else None
        return SpawnGoal(np.array(point[:2]), area)

    # -- single subtasks -------------------------------------------------------------------------------------------

    def _pick_position(self, plan: TaskPlan, episode: Episode) -> int:
        found = subtask_positions(plan, self.layout, self.config.subtask, self.config.target)
        if not found:
            raise UsageError(f"no {self.config.subtask} of {self.config.target!r} in task {self.config.task!r}")
        return found[int(stream(episode.seed, "subtask", episode.index).integers(len(found)))]

    def _episode_qpos(self, episode: Episode) -> np.ndarray:
        a = self.sim.addresses
        qpos = self.sim.model(episode.home).qpos0.copy()
        qpos[a.robot_q] = parked_robot_qpos()
        qpos[a.object_q[:, None] + np.arange(7)] = episode.object_pose
        qpos[a.link_q] = episode.link_q
        return qpos

    def _prepare(self, rng: np.random.Generator, episode: Episode, subtask: Subtask, qpos: np.ndarray) -> Held | None:
        """Bring the home into the state in which the subtask comes up; returns what the robot holds."""
        if subtask.kind == SubtaskKind.PICK and subtask.link:
            self._open_link(rng, episode.home, subtask.link, qpos)
            self._carry_along(episode, subtask, qpos)
        elif subtask.kind == SubtaskKind.CLOSE:
            self._open_link(rng, episode.home, subtask.link, qpos)
            target = next(t for t in episode.targets if t.start_link == subtask.link)
            self._put_at_goal(qpos, self.layout.object_names.index(target.obj), target.goal_pos)
        elif subtask.kind == SubtaskKind.OPEN:
            self._leave_ajar(rng, episode, subtask, qpos)
        elif subtask.kind == SubtaskKind.PLACE or (subtask.kind == SubtaskKind.NAVIGATE and subtask.must_hold):
            if subtask.link and qpos[self._link_q(subtask.link)] < 1.0:
                self._open_link(rng, episode.home, subtask.link, qpos)
            return self._hold(rng, subtask, qpos)
        return None

    def _link_q(self, link: str) -> int:
        return int(self.sim.addresses.link_q[self.layout.link_ids.index(link)])

    def _open_link(self, rng: np.random.Generator, home: str, link: str, qpos: np.ndarray) -> None:
        low, high = self.layout.links[self.layout.link_ids.index(link)].link.range
        fraction = rng.uniform(self.task_config.open_fraction(link), OPEN_START_MARGIN)
        at = low + fraction * (high - low)
        qpos[self._link_q(link)] = min(at, dict(self._homes[home].open_limits).get(link, at))

    def _leave_ajar(self, rng: np.random.Generator, episode: Episode, subtask: Subtask, qpos: np.ndarray) -> None:
        """In training, let a drawer start part of the way to open now and then (mshab/envs/open.py)."""
        ref = self.layout.links[self.layout.link_ids.index(subtask.link)]
        if ref.link.joint != "slide" or rng.uniform() >= self.config.open_start:
            return
        low, high = ref.link.range
        qpos[self._link_q(subtask.link)] = low + AJAR * self.task_config.open_fraction(subtask.link) * (high - low)
        self._carry_along(episode, subtask, qpos)

    def _carry_along(self, episode: Episode, subtask: Subtask, qpos: np.ndarray) -> None:
        """An object in a drawer moves with it (mshab/utils/gen/gen_spawn_positions.py)."""
        ref = self.layout.links[self.layout.link_ids.index(subtask.link)]
        if ref.link.joint != "slide":
            return
        yaw = self.layout.articulation_placement(self._homes[episode.home], ref.articulation).yaw
        start = self.sim.addresses.object_q[self.layout.object_names.index(subtask.obj)]
        moved = qpos[self._link_q(subtask.link)] - episode.link_q[self.layout.link_ids.index(subtask.link)]
        ax, ay, _ = ref.link.axis
        direction = np.array([np.cos(yaw) * ax - np.sin(yaw) * ay, np.sin(yaw) * ax + np.cos(yaw) * ay])
        qpos[start : start + 2] += moved * direction

    def _put_at_goal(self, qpos: np.ndarray, slot: int, goal: tuple[float, float, float]) -> None:
        start = self.sim.addresses.object_q[slot]
        qpos[start : start + 3] = goal
        qpos[start + 2] += 0.001

    def _hold(self, rng: np.random.Generator, subtask: Subtask, qpos: np.ndarray) -> Held:
        slot = self.layout.object_names.index(subtask.obj)
        grasps = self.held.grasps(self.layout.roster[slot])
        grasp = grasps[int(rng.integers(len(grasps)))]
        robot = np.array(REST_QPOS, dtype=np.float64)
        robot[13:15] = grasp.fingers
        qpos[self.sim.addresses.robot_q] = robot
        return Held(slot, grasp.pose)

    # -- where the robot stands ------------------------------------------------------------------------------------

    def _spawn(
        self, episode: Episode, home: str, qpos: np.ndarray, goal: SpawnGoal, held: Held | None
    ) -> tuple[np.ndarray, bool]:
        for attempt in range(MAX_TRIES):
            rng = stream(episode.seed, "spawn", episode.task, episode.index, attempt)
            found = self.sampler.try_once(home, qpos, goal, rng, held)
            if found is not None:
                return found, False
        return self.sampler.fallback(home, qpos, goal, held), True

    def _roam(self, episode: Episode, qpos: np.ndarray) -> tuple[np.ndarray, bool]:
        """A chain begins with the robot somewhere in the home; its first Navigate brings it to work."""
        fmap = self.sampler.map(episode.home)
        rng = stream(episode.seed, "roam", episode.task, episode.index)
        cells = fmap.to_xy(np.argwhere(fmap.navigable(0.5)))
        for _ in range(MAX_TRIES):
            xy = cells[int(rng.integers(len(cells)))]
            heading = rng.uniform(-np.pi, np.pi)
            face = xy + np.array([np.cos(heading), np.sin(heading)])
            found = self.sampler.at(episode.home, qpos, xy, SpawnGoal(face))
            if found is not None:
                return found, False
        return self.sampler.fallback(episode.home, qpos, SpawnGoal(cells[0])), True
