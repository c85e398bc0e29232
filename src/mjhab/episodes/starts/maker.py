"""Make start states of whole chains and of single subtasks."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.core.errors import MjhabError, UsageError, about, unknown_name, wrong_value
from mjhab.core.names import kind_of
from mjhab.core.registration.plugins import resolved
from mjhab.core.seeding import stream
from mjhab.episodes.episode import Episode
from mjhab.episodes.grasps.carry_postures import CarryPostures
from mjhab.episodes.grasps.stable import StableGrasps
from mjhab.episodes.spawn_sets import SpawnSet
from mjhab.episodes.spawns import MAX_TRIES, Held, SpawnGoal, SpawnSampler
from mjhab.episodes.starts.fronts import link_front
from mjhab.episodes.starts.home_state import HomeState
from mjhab.episodes.starts.scene import Start, StartContext, SubtaskContext, SubtaskStart
from mjhab.layout.layout import Layout
from mjhab.scenes.roles import link_with_role, roles_of
from mjhab.scenes.spec import Home
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import parked_robot_qpos
from mjhab.tasks.household.registry import TASKS, chain
from mjhab.tasks.plan import GOAL_OF, Box, Subtask, TaskPlan
from mjhab.tasks.subtasks.registry import SUBTASKS, number_of, spec_of
from mjhab.tasks.thresholds import TaskConfig

ROAM_RADIUS_M = 0.5
"""Radius [m] of the free disc at the spawn of a whole chain."""


def subtask_positions(
    plan: TaskPlan, layout: Layout, kind: str, target: str
) -> list[int]:
    """Return the positions in a plan of the subtasks of one kind and target.

    Args:
        plan: the plan.
        layout: not used.
        kind: name of the subtask.
        target: object type, object name or link id; "" for any.
    """

    def matches(subtask: Subtask) -> bool:
        about = subtask.link if SUBTASKS[kind].jointed else subtask.obj
        return not target or about == target or kind_of(about) == target

    wanted = number_of(kind)
    return [i for i, s in enumerate(plan.subtasks) if s.kind == wanted and matches(s)]


def valid_targets(config: EnvConfig, layout: Layout) -> list[str]:
    """Return the object types or link ids that ``config.target`` may name for its task and subtask."""
    task = TASKS[config.task]
    if config.subtask and SUBTASKS[config.subtask].jointed:
        return _opened_links(config.task, layout)
    return list(task.object_types) or sorted(set(layout.roster))


def _opened_links(task: str, layout: Layout) -> list[str]:
    """Return the ids of the links that the plans of a task open in the homes of a layout, without repeats."""
    pack = layout.pack
    found: list[str] = []
    for role in TASKS[task].opened_links:
        links = [roles_of(pack, home).links.get(role) for home in pack.homes]
        # Of a role that no home has, the error says which ones the pack has.
        found += filter(None, links) if any(links) else [link_with_role(pack.roles, role)]
    # A dict keeps the order, which the messages show.
    return list(dict.fromkeys(found))


def aims_of(config: EnvConfig, layout: Layout) -> list[str]:
    """Return the types of the targets that the single-subtask episodes of a configuration are about.

    They are those of `valid_targets`, or ``config.target`` alone. A Navigate leads to objects, to their goals and to
    the links that are opened; with a target it carries this object to its goal.
    """
    named = [config.target] if config.target else valid_targets(config, layout)
    if not config.subtask or not SUBTASKS[config.subtask].navigates:
        return named
    goals = [f"{GOAL_OF}{name}" for name in named]
    if config.target:
        return goals
    return [*named, *goals, *_opened_links(config.task, layout)]


def check_target(config: EnvConfig, layout: Layout) -> None:
    """Check the target of a configuration.

    Raises:
        UsageError: ``config.target`` is not one of `valid_targets`, or there is no subtask for it.
    """
    if not config.target:
        return
    valid = valid_targets(config, layout)
    if config.target not in valid:
        raise unknown_name("target", config.target, valid)
    if not config.subtask:
        subtasks = ", ".join(TASKS[config.task].subtasks)
        raise wrong_value(
            "target",
            config.target,
            "left out without a subtask",
            f"Add --subtask, one of {subtasks}.",
        )


def start_of(kind: int) -> SubtaskStart:
    """Return the `SubtaskStart` of a kind of subtask.

    Raises:
        UsageError: there is no such subtask, or the ``start`` of its spec is not a `SubtaskStart`.
    """
    spec = spec_of(kind)
    where = f"{SUBTASKS.described(spec.name)}: start"
    with about(where, UsageError):
        start = resolved(spec.start)
    if not isinstance(start, SubtaskStart):
        given = (
            f"the class {start.__name__}"
            if isinstance(start, type)
            else type(start).__name__
        )
        raise wrong_value(
            where,
            given,
            "an object of a subclass of mjhab.episodes.starts.SubtaskStart, or a reference 'module:NAME' to one",
        )
    return start


class StartMaker:
    """Makes starts of whole chains and of single subtasks.

    Args:
        sim: CPU simulator of the layout; its compiled models are used, its worlds are not changed.
        config: configuration of the environment.
        task_config: thresholds of success.
        harvested: starts with a held object also use grasps added by `StableGrasps.add`.

    Raises:
        UsageError: ``harvested`` with the published spawn rule, or the spawn set does not fit.
    """

    def __init__(
        self,
        sim: CpuSimulator,
        config: EnvConfig,
        task_config: TaskConfig,
        harvested: bool = False,
    ) -> None:
        self.sim = sim
        self.config = config
        self.task_config = task_config
        self.layout = sim.layout
        self.sampler = SpawnSampler(sim)
        self.held = StableGrasps(sim, task_config, self.sampler.scratch, harvested)
        self.published = config.spawn_rule == "published"
        if self.published and harvested:
            raise wrong_value(
                "harvested",
                True,
                "left out: the published spawn rule has arms of its own",
            )
        self.arms = CarryPostures(self.held)
        self.spawn_set = (
            SpawnSet.load(Path(config.spawns), self.layout) if config.spawns else None
        )
        if self.spawn_set is not None:
            self.spawn_set.check(config)
        self._homes = self.layout.pack.homes_by_name
        self._boxes: dict[str, dict[str, Box]] = {}
        self._state = HomeState(
            config, task_config, sim, self.sampler, self.held, self.arms, self._homes
        )

    def start(self, episode: Episode) -> Start:
        """Return the start of an episode; (seed, index) of the episode seed all draws.

        With ``config.spawns`` it is the start of that spawn set for the episode's index.
        """
        home = self._homes[episode.home]
        boxes = self.boxes(home)
        plan = chain(episode.task, episode.targets, home.name)
        if self.spawn_set is not None:
            row = self.spawn_set.row(episode.index)
            own = plan.only(row.position) if self.config.subtask else plan
            return Start(
                own, home.name, row.qpos, boxes, row.fallback, row.position, row.tries
            )
        if not self.config.subtask:
            qpos, fallback, tries = self.roam(episode, self.episode_qpos(episode))
            return Start(plan, home.name, qpos, boxes, fallback, tries=tries)
        return self.start_at(episode, plan, self.position_of(plan, episode))

    def start_at(self, episode: Episode, plan: TaskPlan, position: int) -> Start:
        """Return the start of the subtask at a position of the episode's plan alone; see `start`."""
        home = self._homes[episode.home]
        boxes = self.boxes(home)
        qpos = self.episode_qpos(episode)
        # Apart from the stream of the spawn: how the home is prepared must not change with the number of tries.
        rng = stream(episode.seed, "start", episode.task, episode.index)
        scene = StartContext(plan, position, boxes, self._state, episode, qpos, rng)
        begin = start_of(scene.subtask.kind)
        held = begin.prepare(scene)
        goal = begin.stand(scene)
        if self.published:
            # In the original the noise may carry the base beyond the distance that its cell was drawn within.
            goal = dataclasses.replace(goal, slack=np.inf, published=True)
        qpos, fallback, tries = self._spawn(episode, qpos, goal, held)
        return Start(
            plan.only(position), home.name, qpos, boxes, fallback, position, tries
        )

    def starts(self, episodes: Sequence[Episode], threads: int = 1) -> list[Start]:
        """Return the starts of several episodes; they do not depend on the number of ``threads``.

        One thread makes a thousand per second, half of it in Python code, so that more threads gain little.
        """
        if threads <= 1:
            return [self.start(episode) for episode in episodes]
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(self.start, episodes))

    def home(self, name: str) -> Home:
        """Return the home with a name."""
        return self._homes[name]

    def boxes(self, home: Home) -> dict[str, Box]:
        """Return the floor area in front of every link of a home: x_min, x_max, y_min, y_max [m], world frame."""
        if home.name not in self._boxes:
            # Kept, since every start in the home needs them.
            self._boxes[home.name] = {
                link: link_front(self.layout, home, link).box
                for link in self.layout.link_ids
            }
        return self._boxes[home.name]

    def spawn_goal(
        self, plan: TaskPlan, position: int, boxes: Mapping[str, Box]
    ) -> SpawnGoal:
        """Return constraints of the pose in which a Navigate to the subtask at ``position`` of a plan ends."""
        situation = SubtaskContext(plan, position, boxes, self._state)
        return start_of(situation.subtask.kind).approach(situation)

    def foresee(self, episode: Episode, plan: TaskPlan, position: int) -> np.ndarray:
        """Predict the state (nq,) of a chain at the Navigate at ``position`` if all subtasks before it succeed.

        The robot and an object that it then carries are parked.
        """
        qpos = self.episode_qpos(episode)
        for subtask in plan.subtasks[:position]:
            if spec_of(subtask.kind).brings_to_goal:
                self._state.put_at_goal(qpos, subtask.obj, subtask.goal_pos)
        situation = SubtaskContext(plan, position, {}, self._state)
        link, placed = situation.open_before()
        if link:
            # The position is part of the name, as a chain is foreseen at each of its Navigates.
            rng = stream(episode.seed, "foresee", episode.task, episode.index, position)
            self._state.leave_open(rng, episode, link, qpos, placed=placed)
        if situation.subtask.must_hold:
            self._state.park(qpos, situation.subtask.obj)
        return qpos

    def position_of(self, plan: TaskPlan, episode: Episode) -> int:
        found = subtask_positions(
            plan, self.layout, self.config.subtask, self.config.target
        )
        if not found:
            raise UsageError(
                f"no {self.config.subtask} of {self.config.target!r} in task {self.config.task!r}"
            )
        first = int(stream(episode.seed, "subtask", episode.index).integers(len(found)))
        # Skip objects that are too wide for the gripper.
        for position in (*found[first:], *found[:first]):
            if self.holdable(plan.subtasks[position]):
                return position
        raise MjhabError(
            f"robot {self.layout.robot.name!r} cannot hold any object of episode {episode.index} of {episode.task}"
        )

    def holdable(self, subtask: Subtask) -> bool:
        """Return whether the gripper can hold the object that a subtask starts with in it, if any."""
        if not spec_of(subtask.kind).starts_holding and not subtask.must_hold:
            return True
        slot = self.layout.object_names.index(subtask.obj)
        return self.held.holds(self.layout.roster[slot])

    def episode_qpos(self, episode: Episode) -> np.ndarray:
        """Return the state (nq,) of an episode's home with its objects and links; the robot is parked."""
        a = self.sim.addresses
        qpos = self.sim.model(episode.home).qpos0.copy()
        qpos[a.robot_q] = parked_robot_qpos(self.layout.robot)
        qpos[a.object_q[:, None] + np.arange(7)] = episode.object_pose
        qpos[a.link_q] = episode.link_q
        return qpos

    def _spawn(
        self, episode: Episode, qpos: np.ndarray, goal: SpawnGoal, held: Held | None
    ) -> tuple[np.ndarray, bool, int]:
        """Sample a spawn.

        Returns:
            State (nq,); True if no sampled spawn was valid and the fallback is used; number of sampled spawns.
        """
        name = ("spawn", episode.task, episode.index)
        # A stream per attempt: try 7 is the same whatever the tries before it drew.
        rngs = (stream(episode.seed, *name, attempt) for attempt in range(MAX_TRIES))
        found, tries = self.sampler.search(episode.home, qpos, goal, rngs, held)
        if found is None:
            return self.sampler.fallback(episode.home, qpos, goal, held), True, tries
        return found, False, tries

    def roam(self, episode: Episode, qpos: np.ndarray) -> tuple[np.ndarray, bool, int]:
        """Sample a spawn for a whole chain, anywhere in the home.

        Returns:
            State (nq,); True if no sampled spawn was valid and the fallback is used; number of sampled spawns.
        """
        rng = stream(episode.seed, "roam", episode.task, episode.index)
        cells = self.sampler.walkable(episode.home, ROAM_RADIUS_M)
        for attempt in range(MAX_TRIES):
            xy = cells[int(rng.integers(len(cells)))]
            heading = rng.uniform(-np.pi, np.pi)
            face = xy + np.array([np.cos(heading), np.sin(heading)])
            found = self.sampler.at(episode.home, qpos, xy, SpawnGoal(face))
            if found is not None:
                return found, False, attempt + 1
        return (
            self.sampler.fallback(episode.home, qpos, SpawnGoal(cells[0])),
            True,
            MAX_TRIES,
        )
