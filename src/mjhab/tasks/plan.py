"""Task plans: which subtasks a robot has to do, in which order, and the same as arrays."""

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
    """Numbers of the subtasks of mjhab itself, as in mshab/envs/planner.py; those of plugins follow."""

    PICK = 0
    PLACE = 1
    NAVIGATE = 2
    OPEN = 3
    CLOSE = 4


@dataclass(frozen=True)
class Target:
    """One object of a task: where it is, where it belongs, and what must be opened for it. World frame [m].

    ``start_link``/``goal_link`` name a link such as ``"kitchen_counter/drawer3"`` if the object starts in, or
    belongs into, a piece of furniture that opens; ``handle_pos`` is the handle of the one that the plan opens.
    """

    obj: str
    goal_pos: Vec3
    start_pos: Vec3 = (0.0, 0.0, 0.0)
    start_link: str = ""
    goal_link: str = ""
    handle_pos: Vec3 = (0.0, 0.0, 0.0)


GOAL_OF = "goal of "
"""Before the name of an object: the name of a navigation that leads to where the object goes."""


@dataclass(frozen=True)
class Subtask:
    """One step of a plan.

    ``kind``: its number (`subtasks.registry.number_of`).
    ``obj``: object to pick or place, the object behind the link to open, or the object carried while navigating.
    ``link``: the link to open or close, the one the object is in or goes into, or the one to navigate to.
    ``goal_pos`` [m, world]: place goal, point to navigate to, handle at the start of the episode; unused by pick.
    ``toward``: what a navigation leads to, an object or a link, for display. ``goal_rect`` (4 corners, in order
    around the rectangle, world xy) is the place zone, needed for goal_type "zone" only.
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
        """Name of what the subtask is about: the object, the link, or what to navigate to."""
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
    """Put the plans of W worlds into arrays, padded to the longest.

    Args:
        plans: one plan per world.
        config: gives the open fractions.
        boxes: per world, the floor area in front of a link from which it can be reached. It binds a Navigate with
            that ``link`` and nothing in the hand (mshab/envs/navigate.py).
        doors: links that turn on a hinge; others slide. They count as open at another part of their range.
        min_subtasks: pad to at least so many subtasks, so that array shapes do not depend on the plans drawn.
    """
    count = max(min_subtasks, *(len(plan.subtasks) for plan in plans))
    shape = (len(plans), count)
    kind = np.full(shape, PADDING, dtype=np.int64)
    goal_pos = np.zeros((*shape, 3))
    must_hold = np.zeros(shape, dtype=bool)
    open_frac = np.full(shape, config.open_fraction_drawer)
    box = np.full((*shape, 4), np.nan)
    rect = np.full((*shape, 4, 2), np.nan)
    for w, plan in enumerate(plans):
        for s, subtask in enumerate(plan.subtasks):
            kind[w, s] = subtask.kind
            goal_pos[w, s] = subtask.goal_pos
            must_hold[w, s] = subtask.must_hold
            open_frac[w, s] = config.open_fraction(hinged=subtask.link in doors)
            if boxes is not None and spec_of(subtask.kind).navigates and not subtask.must_hold:
                box[w, s] = boxes[w].get(subtask.link, (np.nan,) * 4)
            if subtask.goal_rect:
                rect[w, s] = subtask.goal_rect
    length = np.array([len(plan.subtasks) for plan in plans], dtype=np.int64)
    zones = rect if config.goal_type == "zone" else None
    return PlanArrays(kind, length, goal_pos, must_hold, open_frac, box, zones)
