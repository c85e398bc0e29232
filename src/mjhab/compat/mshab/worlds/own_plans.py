"""Plans of mjhab's generator as MS-HAB's, for environments that were given none."""

from __future__ import annotations

from typing import Any

from mjhab.compat.mshab.files.matching import object_id
from mjhab.compat.mshab.files.plans import TaskPlan
from mjhab.compat.mshab.files.subtasks import (
    ArticulationConfig,
    CloseSubtask,
    NavigateSubtask,
    OpenSubtask,
    PickSubtask,
    PlaceSubtask,
    Subtask,
)
from mjhab.core.arrays import to_numpy
from mjhab.envs.loop import TaskLoop
from mjhab.tasks.plan import Subtask as OwnSubtask

HANDLES = {
    "fridge/top_door": (2, 0),
    "kitchen_counter/drawer3": (7, 5),
}
"""Numbers of the link and of its joint in MS-HAB's plans, of the parts that its tasks open."""


def own_plan(worlds: TaskLoop, world: int) -> TaskPlan:
    """The plan of a world's episode."""
    about: Any = worlds.episode_spec(world)  # type: ignore[attr-defined]
    if hasattr(worlds, "pool"):
        pool: Any = worlds.pool  # type: ignore[attr-defined]
        plan = pool.plans[int(to_numpy(worlds.start_row)[world])]  # type: ignore[attr-defined]
    else:
        plan = worlds.tables.plans[world]  # type: ignore[attr-defined]
    name = worlds.config.subtask or "sequential"
    stem = f"{about['task']}-{name}-{about['split']}-{about['index']}"
    subtasks = []
    for number, subtask in enumerate(plan.subtasks):
        made = _told(subtask)
        made.uid = f"{stem}-{number}"
        made.composite_subtask_uids = [made.uid]
        subtasks.append(made)
    home = f"{about['home']}.scene_instance.json"
    arrangement = f"{about['split']}/{about['task']}/episode_{about['index']}.json"
    return TaskPlan(subtasks, home, arrangement)


def _told(subtask: OwnSubtask) -> Subtask:
    behind = _furniture(subtask.link) if subtask.link else None
    kind = subtask.name
    if kind == "pick":
        return PickSubtask(object_id(subtask.obj), behind)
    if kind == "place":
        return PlaceSubtask(
            object_id(subtask.obj),
            goal_pos=list(subtask.goal_pos),
            articulation_config=behind,
        )
    if kind == "navigate":
        return NavigateSubtask(
            object_id(subtask.obj) if subtask.obj else None,
            list(subtask.goal_pos),
            articulation_config=behind,
        )
    assert behind is not None
    fields = vars(behind)
    if kind == "open":
        return OpenSubtask(
            **fields, obj_id=object_id(subtask.obj), articulation_relative_handle_pos=None
        )
    return CloseSubtask(**fields, articulation_relative_handle_pos=None)


def _furniture(link: str) -> ArticulationConfig:
    kind = link.partition("/")[0]
    return ArticulationConfig(kind, f"{kind}-0", *HANDLES.get(link, (-1, -1)))
