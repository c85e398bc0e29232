"""Task plans: the sequence of subtasks of an episode, and the plans of many worlds as arrays."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from mjhab.core.arrays import Array
from mjhab.tasks.subtasks.registry import PADDING, name_of, spec_of
from mjhab.tasks.thresholds import TaskConfig, Vec3

Box = tuple[float, float, float, float]
"""A rectangle on the floor in world axes: x_min, x_max, y_min, y_max [m]."""


class SubtaskKind(IntEnum):
    """Numbers of mjhab's own subtasks, as in mshab/envs/planner.py; those of plugins follow."""

    PICK = 0
    PLACE = 1
    NAVIGATE = 2
    OPEN = 3
    CLOSE = 4


@dataclass(frozen=True)
class Target:
    """One object of a task with its start and goal.

    Attributes:
        obj: name of the object.
        goal_pos: goal position in the world [m].
        start_pos: start position in the world [m].
        start_link: link such as ``"kitchen_counter/drawer3"`` in or behind which the object starts, "" for none.
        goal_link: link in or behind which its goal is, "" for none.
        handle_pos: handle position of the link that the plan opens, in the world [m].
    """

    obj: str
    goal_pos: Vec3
    start_pos: Vec3 = (0.0, 0.0, 0.0)
    start_link: str = ""
    goal_link: str = ""
    handle_pos: Vec3 = (0.0, 0.0, 0.0)


GOAL_OF = "goal of "
"""Prefix of an object's name in `Subtask.toward`: the navigation leads to the object's goal."""


@dataclass(frozen=True)
class Subtask:
    """One step of a plan.

    Attributes:
        kind: number of its kind (`subtasks.registry.number_of`).
        obj: object to pick or place, object behind the link to open, or object carried while navigating.
        link: link to open or close, link that the object is in or goes into, or link to navigate to.
        goal_pos: place goal, point to navigate to, or handle at the start of the episode, in the world [m]; unused by
            Pick.
        must_hold: a Navigate carries ``obj``.
        toward: object or link that a navigation leads to, for display.
        goal_rect: 4 corners of the place zone, in order around the rectangle, world xy [m]; needed for goal_type "zone"
            only.
    """

    kind: int
    obj: str = ""
    link: str = ""
    goal_pos: Vec3 = (0.0, 0.0, 0.0)
    must_hold: bool = False
    toward: str = ""
    goal_rect: tuple[tuple[float, float], ...] = ()

    @property
    def name(self) -> str:
        """Name of its kind, such as "pick"."""
        return name_of(self.kind)

    @property
    def target(self) -> str:
        """Name of the target: the object, the link, or the object or link to navigate to."""
        about = spec_of(self.kind).about
        if about == "way":
            return self.toward or self.obj or self.link
        return self.link if about == "link" else self.obj


@dataclass(frozen=True)
class TaskPlan:
    """The subtasks of one episode in order. ``task`` names the task the plan belongs to."""

    task: str
    subtasks: tuple[Subtask, ...]
    home: str = ""

    def only(self, index: int) -> TaskPlan:
        """Return the plan with just one of the subtasks, to train or evaluate it alone."""
        return replace(self, subtasks=(self.subtasks[index],))

    def indices(self, kind: int) -> tuple[int, ...]:
        """Return the positions of all subtasks of one kind."""
        return tuple(i for i, subtask in enumerate(self.subtasks) if subtask.kind == kind)


@dataclass(frozen=True)
class PlanArrays:
    """The plans of all worlds as arrays: W worlds, S subtasks, shorter plans padded with kind -1."""

    kind: Array
    """(W, S) int64."""
    length: Array
    """(W,) int64, number of real subtasks."""
    goal_pos: Array
    """(W, S, 3) [m, world]: place goal, navigation goal, handle at start; unused by pick."""
    must_hold: Array
    """(W, S) bool: this Navigate carries an object."""
    open_frac: Array
    """(W, S): part of the range at which the link counts as open."""
    box: Array
    """(W, S, 4) [m, world]: x_min, x_max, y_min, y_max the base must reach, all NaN without one."""
    goal_rect: Array | None = field(default=None)
    """(W, S, 4, 2) [m, world] corners of the place zones in order, for goal_type "zone"; NaN without one."""


def stack_plans(
    plans: Sequence[TaskPlan],
    config: TaskConfig,
    boxes: Sequence[Mapping[str, Box]] | None = None,
    min_subtasks: int = 1,
    doors: Collection[str] = (),
) -> PlanArrays:
    """Convert the plans of W worlds to arrays, padded to the longest plan.

    Args:
        plans: one plan per world.
        config: thresholds; gives the open fractions and the goal type.
        boxes: per world, floor areas in front of links by link. A Navigate to that ``link`` with an empty hand must end
            in it (mshab/envs/navigate.py).
        min_subtasks: least number of columns, so that array shapes do not depend on the plans.
        doors: links with a hinge; other links slide. The two have different open fractions.
    """
    # At least as long as asked, so that shapes stay the same over resets.
    count = max(min_subtasks, *(len(plan.subtasks) for plan in plans))
    shape = (len(plans), count)
    # int64, because these numbers index tables on every backend.
    kind = np.full(shape, PADDING, dtype=np.int64)
    goal_pos = np.zeros((*shape, 3))
    must_hold = np.zeros(shape, dtype=bool)
    open_frac = np.full(shape, config.open_fraction_drawer)
    # NaN compares False with everything, which stands for no box without a second array.
    box = np.full((*shape, 4), np.nan)
    rect = np.full((*shape, 4, 2), np.nan)
    for w, plan in enumerate(plans):
        for s, subtask in enumerate(plan.subtasks):
            kind[w, s] = subtask.kind
            goal_pos[w, s] = subtask.goal_pos
            must_hold[w, s] = subtask.must_hold
            open_frac[w, s] = config.open_fraction(hinged=subtask.link in doors)
            # The box says where to stand for a link; who carries something drives to the goal of the object.
            if (
                boxes is not None
                and spec_of(subtask.kind).navigates
                and not subtask.must_hold
            ):
                box[w, s] = boxes[w].get(subtask.link, (np.nan,) * 4)
            if subtask.goal_rect:
                rect[w, s] = subtask.goal_rect
    length = np.array([len(plan.subtasks) for plan in plans], dtype=np.int64)
    # None spares the arrays where no goal is a zone.
    zones = rect if config.goal_type == "zone" else None
    return PlanArrays(kind, length, goal_pos, must_hold, open_frac, box, zones)
