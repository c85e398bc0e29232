"""PrepareGroceries: two objects from the open fridge to the counter, one back.

habitat-lab hab/prepare_groceries.yaml.
"""

from __future__ import annotations

from mjhab.tasks.household.spec import TargetRule, TaskSpec

FRIDGE_PREOPEN_RAD = 1.5
"""The door of the fridge stands open by so much from the start (HAB prepare_groceries, ao_states)."""
SHELF_REGION = 0.9
"""Two targets and the goal of a third do not fit into HAB's half of our shelf without touching."""
_OUT = TargetRule(start=("fridge_shelf",), goal=("counter_top",))
_IN = TargetRule(start=("counter_top",), goal=("fridge_shelf",))

PREPARE_GROCERIES = TaskSpec(
    name="prepare_groceries",
    words=("prepare the groceries", "sort the groceries", "put the groceries away"),
    targets=(_OUT, _OUT, _IN),
    objects=("003_cracker_box", "005_tomato_soup_can", "024_bowl"),
    openings=(("fridge_door", FRIDGE_PREOPEN_RAD),),
    shelf_region=SHELF_REGION,
    departs_from_last_goal=True,
)
