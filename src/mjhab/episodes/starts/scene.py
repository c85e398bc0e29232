"""What the start of a subtask is made from, and what it has to say: `SubtaskStart` is the base of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.episodes.generator import Episode
from mjhab.episodes.spawns import Held, SpawnGoal
from mjhab.episodes.starts.home_state import HomeState
from mjhab.scenes.spec import Home
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.plan import Box, Subtask, TaskPlan
from mjhab.tasks.subtasks.registry import spec_of


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


@dataclass(frozen=True, eq=False)
class Situation:
    """A subtask at a position of a plan. boxes: floor area in front of every link of the home. state: see there."""

    plan: TaskPlan
    position: int
    boxes: Mapping[str, Box]
    state: HomeState

    @property
    def subtask(self) -> Subtask:
        """The subtask that begins."""
        return self.plan.subtasks[self.position]

    @property
    def area(self) -> np.ndarray | None:
        """(4,) floor area [m] in front of the subtask's link: x_min, x_max, y_min, y_max; None without a link."""
        return np.array(self.boxes[self.subtask.link]) if self.subtask.link else None

    @property
    def last_way(self) -> tuple[float, float, float]:
        """Where the last Navigate before the subtask led to [m, world].

        Raises:
            UsageError: there is none in the plan.
        """
        for subtask in reversed(self.plan.subtasks[: self.position]):
            if spec_of(subtask.kind).navigates:
                return subtask.goal_pos
        raise UsageError(
            f"{TASKS.told(self.plan.task)}: subtask {self.subtask.name!r} begins where the navigate before it led to, "
            f"but no navigate is before position {self.position} of the plan. Put one into the chain of the TargetRule."
        )

    def open_before(self) -> tuple[str, bool]:
        """The link that the plan has left open by now, or "", and whether its object is placed by then."""
        link = ""
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
class Scene(Situation):
    """A subtask that is done alone. qpos: (nq,) state of the home, robot parked; rng: of the start."""

    episode: Episode
    qpos: np.ndarray
    rng: np.random.Generator

    @property
    def home(self) -> Home:
        """The home of the episode."""
        return self.state.homes[self.episode.home]


class SubtaskStart:
    """How the home and the robot begin one kind of subtask. Its methods are called in the order in which they stand.

    The usual one changes nothing in the home and faces the goal of the subtask; subclasses say what differs.
    """

    def prepare(self, scene: Scene) -> Held | None:
        """Bring ``scene.qpos`` into the state in which the subtask comes up; returns what the robot holds."""
        return None

    def stand(self, scene: Scene) -> SpawnGoal:
        """Where the robot stands when the subtask is done alone."""
        return self.approach(scene)

    def approach(self, situation: Situation) -> SpawnGoal:
        """Where a robot stands that has navigated to the subtask, or does so now."""
        return SpawnGoal(np.array(situation.subtask.goal_pos[:2]), situation.area)
