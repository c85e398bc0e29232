"""Plans of mjhab's generator as MS-HAB's, for environments that were given none."""

from __future__ import annotations

from typing import Any

from mjhab.compat.mshab.files.matching import SCENE_SUFFIX, subtask_in_files
from mjhab.compat.mshab.files.plans import MsHabTaskPlan
from mjhab.compat.mshab.files.subtasks import NavigateSubtask
from mjhab.core.arrays import to_numpy
from mjhab.envs.loop import TaskLoop
from mjhab.tasks.household.registry import chain


def own_plan(worlds: TaskLoop, world: int) -> MsHabTaskPlan:
    """The plan of a world's episode."""
    own: Any = worlds
    if hasattr(worlds, "pool"):
        row = int(to_numpy(own.start_row)[world])
        plan, episode = own.pool.plans[row], own.pool.episodes[row]
    else:
        plan, episode = own.tables.plans[world], own.episodes_now[world]
    whole = chain(episode.task, episode.targets, episode.home)
    name = worlds.config.subtask or "sequential"
    stem = f"{episode.task}-{name}-{episode.split}-{episode.index}"
    subtasks = []
    for number, subtask in enumerate(plan.subtasks):
        # What MS-HAB writes of a subtask depends on those around it in the whole task.
        position = whole.subtasks.index(subtask)
        made = subtask_in_files(worlds.layout, whole, position)
        # MS-HAB has no plan of a drive to an object behind a link that is open.
        made = made or NavigateSubtask(None, list(subtask.goal_pos))
        made.uid = f"{stem}-{number}"
        made.composite_subtask_uids = [made.uid]
        subtasks.append(made)
    arrangement = f"{episode.split}/{episode.task}/episode_{episode.index}.json"
    return MsHabTaskPlan(subtasks, f"{episode.home}{SCENE_SUFFIX}", arrangement)
