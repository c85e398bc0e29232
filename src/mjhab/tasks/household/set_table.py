"""SetTable: the bowl out of a drawer and the apple out of the fridge onto the table.

habitat-lab hab/set_table.yaml.
"""

from __future__ import annotations

from mjhab.tasks.household.spec import TargetRule, TaskSpec

BOWL_DRAWER = "kitchen_counter/drawer3"
FRIDGE_DOOR = "fridge/top_door"
"""Links with the roles "kitchen_drawer" and "fridge_door", in the built-in pack and in ReplicaCAD."""
SET_TABLE = TaskSpec(
    name="set_table",
    words=("set the table", "lay the table"),
    targets=(
        TargetRule(
            start=("drawer",),
            goal=("dining_table",),
            object="024_bowl",
            opens="start",
            link="kitchen_drawer",
        ),
        TargetRule(
            start=("fridge_shelf",),
            goal=("dining_table",),
            object="013_apple",
            opens="start",
            link="fridge_door",
        ),
    ),
    objects=("024_bowl", "013_apple"),
    # So that the apple is not alone on its shelf, as among the clutter of the HAB episodes.
    shelf_clutter=1,
)
