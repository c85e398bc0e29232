"""SetTable: the bowl out of a drawer and the apple out of the fridge onto the table.

habitat-lab hab/set_table.yaml.
"""

from __future__ import annotations

from mjhab.tasks.household.spec import TargetRule, TaskSpec

SET_TABLE = TaskSpec(
    name="set_table",
    words="Set the table.",
    targets=(
        TargetRule(("bowl_drawer",), ("dining_table",), object="024_bowl", opens="start"),
        TargetRule(("fridge_shelf",), ("dining_table",), object="013_apple", opens="start"),
    ),
    objects=("024_bowl", "013_apple"),
    shelf_clutter=1,
)
