"""Plans of all worlds as tables: which object, link and contact column every subtask is about."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjhab.scenes.layout import Layout
from mjhab.tasks.measure import Active
from mjhab.tasks.plan import PADDING, Box, PlanArrays, SubtaskKind, TaskConfig, TaskPlan, stack_plans


@dataclasses.dataclass(frozen=True, eq=False)
class Focus:
    """What the active subtask of every world is about; the last one's once the plan is finished.

    ``kind`` (W,) int64, never -1 for a plan that has subtasks; ``obj``, ``link`` (W,) slot and index, -1 for none;
    ``columns`` (W, 2): of the target and of what Navigate carries among objects then links, -1 for none; ``shown``
    (W, 3) 1.0 or 0.0: the observation has a tool, an object, a goal pose; ``active``: the entries for `measure`.
    """

    kind: np.ndarray
    obj: np.ndarray
    link: np.ndarray
    columns: np.ndarray
    shown: np.ndarray
    active: Active


class PlanTables:
    """Plan arrays of W worlds with rows that change as episodes begin. S subtasks.

    ``arrays``: the PlanArrays of tasks; ``target`` (W, S): column of the subtask's target among objects then links, -1
    for none; ``held`` (W, S): column of the object that Navigate carries; ``obj`` (W, S) object slot, ``link`` (W, S)
    link index, -1 for none. Place, Open and so on read their own.
    """

    def __init__(self, layout: Layout, config: TaskConfig, num_worlds: int, num_subtasks: int) -> None:
        self.layout, self.config, self.num_subtasks = layout, config, num_subtasks
        empty = TaskPlan("", ())
        self.plans: list[TaskPlan] = [empty] * num_worlds
        plain = stack_plans([empty] * num_worlds, config, min_subtasks=num_subtasks)
        self._rows = np.arange(num_worlds)
        # All that is looked up for the active subtask lies side by side, so that one look-up per step gets it.
        self._ids = np.full((num_worlds, num_subtasks, 5), -1)
        self._values = np.zeros((num_worlds, num_subtasks, 11))
        kind, self.obj, self.link, self.target, self.held = (self._ids[..., i] for i in range(5))
        v = self._values
        self._shown = v[..., 8:11]
        self.arrays = dataclasses.replace(plain, kind=kind, goal_pos=v[..., :3], open_frac=v[..., 3], box=v[..., 4:8])

    def set_row(self, world: int, plan: TaskPlan, boxes: dict[str, Box]) -> None:
        """Give a world a new plan."""
        row = stack_plans([plan], self.config, [boxes], min_subtasks=self.num_subtasks)
        for field in dataclasses.fields(PlanArrays):
            table = getattr(self.arrays, field.name)
            if table is not None:
                table[world] = getattr(row, field.name)[0]
        self.plans[world] = plan
        for table in (self.target, self.held, self.obj, self.link):
            table[world] = -1
        objects, links = self.layout.object_names, self.layout.link_ids
        for s, subtask in enumerate(plan.subtasks):
            slot = objects.index(subtask.obj) if subtask.obj else -1
            link = links.index(subtask.link) if subtask.link else -1
            jointed = subtask.kind in (SubtaskKind.OPEN, SubtaskKind.CLOSE)
            self.obj[world, s], self.link[world, s] = slot, link
            self.target[world, s] = len(objects) + link if jointed else slot
            if subtask.must_hold:
                self.held[world, s] = slot
            self._shown[world, s] = (
                True,
                slot >= 0 and subtask.kind != SubtaskKind.CLOSE,
                subtask.kind != SubtaskKind.PICK,
            )

    def focus(self, pointer: np.ndarray) -> Focus:
        """Look up the subtasks at ``pointer`` (W,)."""
        rows, length = self._rows, self.arrays.length
        index = np.minimum(pointer, length - 1)
        ids, values = self._ids[rows, index], self._values[rows, index]
        kind = ids[:, 0]
        must_hold = self.arrays.must_hold[rows, index]
        known = np.where(pointer < length, kind, PADDING)
        active = Active(index, known, values[:, :3], must_hold, values[:, 3], values[:, 4:8])
        return Focus(kind, ids[:, 1], ids[:, 2], ids[:, 3:], values[:, 8:], active)
