"""Base class `SubtaskStart` of the starts of subtasks, and the data that its methods take and return."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mjhab.core.errors import fault
from mjhab.episodes.episode import Episode
from mjhab.episodes.spawns import Held, SpawnGoal
from mjhab.episodes.starts.home_state import HomeState
from mjhab.scenes.spec import Home
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.plan import Box, Subtask, TaskPlan
from mjhab.tasks.subtasks.registry import spec_of


@dataclass(frozen=True, eq=False)
class Start:
    """Start of an episode in a world.

    Attributes:
        plan: plan of the episode.
        home: name of the home.
        qpos: (nq,) state.
        boxes: floor area in front of every link: x_min, x_max, y_min, y_max [m], world frame.
        fallback: the spawn is that of `SpawnSampler.fallback`.
        position: position of the subtask in the episode's chain, 0 for a whole chain.
        tries: sampled spawns.
        perturbed: what came of perturbations of the start, by axis.
    """

    plan: TaskPlan
    home: str
    qpos: np.ndarray
    boxes: dict[str, Box]
    fallback: bool
    position: int = 0
    tries: int = 1
    perturbed: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class SubtaskContext:
    """A subtask at ``position`` of a plan. ``boxes``: as in `Start`; ``state``: changes states of homes."""

    plan: TaskPlan
    position: int
    boxes: Mapping[str, Box]
    state: HomeState

    @property
    def subtask(self) -> Subtask:
        """The subtask at ``position``."""
        return self.plan.subtasks[self.position]

    @property
    def area(self) -> np.ndarray | None:
        """(4,) floor area in front of the subtask's link: x_min, x_max, y_min, y_max [m]; None without a link."""
        return np.array(self.boxes[self.subtask.link]) if self.subtask.link else None

    @property
    def last_way(self) -> tuple[float, float, float]:
        """Goal of the last Navigate before the subtask, world frame [m].

        Raises:
            UsageError: there is none in the plan.
        """
        # The nearest one: chains lead to several goals.
        for subtask in reversed(self.plan.subtasks[: self.position]):
            if spec_of(subtask.kind).navigates:
                return subtask.goal_pos
        raise fault(
            TASKS.described(self.plan.task),
            f"subtask {self.subtask.name!r} begins where the navigate before it led to, but no navigate is "
            f"before position {self.position} of the plan. Put one into the chain of the TargetRule.",
        )

    def open_before(self) -> tuple[str, bool]:
        """Return the link that is open when the subtask starts, and whether its object was placed.

        The link is "" if the plan before the subtask leaves none open.
        """
        link = ""
        # The link was opened for another object, which has yet to be placed.
        placed = False
        for subtask in self.plan.subtasks[: self.position]:
            spec = spec_of(subtask.kind)
            if spec.opens_link:
                link = subtask.link
                placed = False
            elif spec.brings_to_goal:
                placed = True
            elif spec.closes_link:
                link = ""
        return link, placed


@dataclass(frozen=True, eq=False)
class StartContext(SubtaskContext):
    """A subtask that is a whole episode. ``qpos``: (nq,) state with the robot parked; ``rng``: draws the start."""

    episode: Episode
    qpos: np.ndarray
    rng: np.random.Generator

    @property
    def home(self) -> Home:
        """The home of the episode."""
        return self.state.homes[self.episode.home]


class SubtaskStart:
    """Start of one kind of subtask: `prepare` changes the home, then `stand` constrains the robot's spawn.

    This base class changes nothing in the home, and the robot faces the goal of the subtask; subclasses override that.
    """

    def prepare(self, scene: StartContext) -> Held | None:
        """Change ``scene.qpos`` in place to the state in which the subtask starts; return the held object, if any."""
        return None

    def stand(self, scene: StartContext) -> SpawnGoal:
        """Return constraints of the spawn for an episode of this subtask alone."""
        return self.approach(scene)

    def approach(self, situation: SubtaskContext) -> SpawnGoal:
        """Return constraints of the pose in which a Navigate to this subtask ends."""
        return SpawnGoal(np.array(situation.subtask.goal_pos[:2]), situation.area)
