"""Plans of all worlds as tables of object slots, link indices and contact columns. Letters: W worlds, S subtasks."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np

from mjhab.core.arrays import Array, namespace, pick_column
from mjhab.layout.layout import Layout
from mjhab.tasks.measure import active_entries
from mjhab.tasks.plan import Box, PlanArrays, TaskPlan, stack_plans
from mjhab.tasks.signals import Active
from mjhab.tasks.subtasks.registry import properties, shown, spec_of
from mjhab.tasks.thresholds import TaskConfig


@dataclasses.dataclass(frozen=True, eq=False)
class Focus:
    """Object, link and properties of the active subtask of every world; of the last one once the plan is finished.

    Attributes:
        kind: (W,) int64 kind; not -1 for a finished plan, unless the plan is empty.
        obj: (W,) object slot, -1 for none.
        link: (W,) link index, -1 for none.
        columns: (W, 2) contact columns (objects, then links) of the target and of the object that a Navigate carries,
            -1 for none.
        has_columns: (W, 2) bool, the column is not -1.
        has_link: (W,) bool, the link is not -1.
        jointed: (W,) bool, `SubtaskSpec.jointed`.
        navigates: (W,) bool, `SubtaskSpec.navigates`.
        shown: (3, W, 1) bool, the observation has the pose of the tcp, of an object, of a goal; the last two are False
            once the plan is finished.
        has_obj: (W, S, 1) bool, each subtask of the plan has an object.
        active: entries of the plan for `measure`.
    """

    kind: Array
    obj: Array
    link: Array
    columns: Array
    has_columns: Array
    has_link: Array
    jointed: Array
    navigates: Array
    shown: Array
    has_obj: Array
    active: Active


class Tables(Protocol):
    """Tables that `look_up` reads; `PlanTables`, which describes them, and `Rows` have them."""

    @property
    def arrays(self) -> PlanArrays: ...
    @property
    def obj(self) -> Array: ...
    @property
    def link(self) -> Array: ...
    @property
    def target(self) -> Array: ...
    @property
    def held(self) -> Array: ...


@dataclasses.dataclass(frozen=True, eq=False)
class Rows:
    """The tables of `PlanTables` as arrays of any library."""

    arrays: PlanArrays
    obj: Array
    link: Array
    target: Array
    held: Array


def look_up(tables: Tables, pointer: Array, config: TaskConfig) -> Focus:
    """Look up the subtasks at ``pointer`` (W,) int64. The result holds copies, not views of the tables."""
    xp = namespace(pointer)
    active = active_entries(tables.arrays, pointer, config)
    columns = (tables.arrays.kind, tables.obj, tables.link, tables.target, tables.held)
    kind, obj, link, target, held = (
        pick_column(table, active.index) for table in columns
    )
    columns = xp.stack([target, held], axis=1)
    object_shown, goal_shown = shown(active.kind)
    jointed, navigates = properties(kind, "jointed", "navigates")
    # The tcp is always shown.
    shows = [kind == kind, object_shown & (obj >= 0), goal_shown]
    has_obj = (tables.obj >= 0)[..., None]
    return Focus(
        kind,
        obj,
        link,
        columns,
        columns >= 0,
        link >= 0,
        jointed,
        navigates,
        xp.stack(shows)[..., None],
        has_obj,
        active,
    )


class PlanTables:
    """Tables of the plans of W worlds; `set_row` replaces the plan of a world when an episode begins.

    Attributes:
        plans: the plans.
        arrays: the plans as `PlanArrays`.
        target: (W, S) contact column (objects, then links) of each subtask's target, -1 for none.
        held: (W, S) contact column of the object that a Navigate carries, -1 for none.
        obj: (W, S) object slot, -1 for none.
        link: (W, S) link index, -1 for none.

    Args:
        layout: layout of the worlds.
        config: thresholds of the task.
        num_worlds: W.
        num_subtasks: S; shorter plans are padded.
    """

    def __init__(
        self, layout: Layout, config: TaskConfig, num_worlds: int, num_subtasks: int
    ) -> None:
        self.layout = layout
        self.config = config
        self.num_subtasks = num_subtasks
        empty = TaskPlan("", ())
        self.plans: list[TaskPlan] = [empty] * num_worlds
        self.arrays: PlanArrays = stack_plans(
            [empty] * num_worlds, config, min_subtasks=num_subtasks
        )
        shape = (num_worlds, num_subtasks)
        # -1 reads the last row, whose values are then set to zero.
        self.target = np.full(shape, -1)
        self.held = np.full(shape, -1)
        self.obj = np.full(shape, -1)
        self.link = np.full(shape, -1)

    def set_row(self, world: int, plan: TaskPlan, boxes: dict[str, Box]) -> None:
        """Set the plan of a world; ``boxes``: floor areas in front of links, see `stack_plans`."""
        row = stack_plans(
            [plan],
            self.config,
            [boxes],
            min_subtasks=self.num_subtasks,
            doors=self.layout.doors,
        )
        for field in dataclasses.fields(PlanArrays):
            table = getattr(self.arrays, field.name)
            # Corners of zones are there for one type of goal only.
            if table is not None:
                table[world] = getattr(row, field.name)[0]
        self.plans[world] = plan
        for table in (self.target, self.held, self.obj, self.link):
            table[world] = -1
        objects = self.layout.object_names
        links = self.layout.link_ids
        for s, subtask in enumerate(plan.subtasks):
            slot = objects.index(subtask.obj) if subtask.obj else -1
            link = links.index(subtask.link) if subtask.link else -1
            jointed = spec_of(subtask.kind).jointed
            self.obj[world, s] = slot
            self.link[world, s] = link
            # Contact columns are objects first, then links.
            self.target[world, s] = len(objects) + link if jointed else slot
            if subtask.must_hold:
                self.held[world, s] = slot

    def focus(self, pointer: np.ndarray) -> Focus:
        """Look up the subtasks at ``pointer`` (W,) int64. The result holds copies, not views of the tables."""
        return look_up(self, pointer, self.config)
