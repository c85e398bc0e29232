"""ClearTable, a household task that mjhab does not have, made of the subtasks that it has.

The bowl goes from the dining table into the sink or onto the counter; the apple goes into the fridge, whose door is
opened before and closed after:

    MJHAB_PLUGINS=examples/clear_table.py mjhab eval --task clear_table --policy expert --episodes 4
"""

from __future__ import annotations

from mjhab import TargetRule, TaskSpec, register_task

CLEAR_TABLE = TaskSpec(
    name="clear_table",
    words=("clear the table", "clear away the dishes"),
    targets=(
        TargetRule(
            start=("dining_table",), goal=("sink", "counter_top"), object="024_bowl"
        ),
        TargetRule(
            start=("dining_table",),
            goal=("fridge_shelf",),
            object="013_apple",
            opens="goal",
            link="fridge_door",
        ),
    ),
    objects=("024_bowl", "013_apple"),
    clutter_copies=1,
)

register_task(CLEAR_TABLE)
