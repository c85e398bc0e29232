"""Plans of all worlds as integer tables: which object, link and contact column every subtask is about."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjhab.scenes.layout import Layout
from mjhab.tasks.plan import Box, PlanArrays, SubtaskKind, TaskConfig, TaskPlan, stack_plans


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
        self.arrays: PlanArrays = stack_plans([empty] * num_worlds, config, min_subtasks=num_subtasks)
        shape = (num_worlds, num_subtasks)
        self.target, self.held = np.full(shape, -1), np.full(shape, -1)
        self.obj, self.link = np.full(shape, -1), np.full(shape, -1)

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
