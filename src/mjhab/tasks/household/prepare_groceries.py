"""PrepareGroceries: two objects from the open fridge to the counter, one back.

habitat-lab hab/prepare_groceries.yaml.
"""

from __future__ import annotations

from mjhab.tasks.household.spec import TargetRule, TaskSpec

FRIDGE_PREOPEN_RAD = 1.5
"""Angle of the fridge door at the start (HAB prepare_groceries, ao_states)."""
SHELF_REGION = 0.9
"""Share of the shelf in which objects are placed. HAB uses 0.5, in which two targets and a goal do not fit here."""
_OUT = TargetRule(start=("fridge_shelf",), goal=("counter_top",))
_IN = TargetRule(start=("counter_top",), goal=("fridge_shelf",))

PREPARE_GROCERIES = TaskSpec(
    name="prepare_groceries",
    words=("prepare the groceries", "sort the groceries", "put the groceries away"),
    targets=(_OUT, _OUT, _IN),
    objects=("003_cracker_box", "005_tomato_soup_can", "024_bowl"),
    openings=(("fridge_door", FRIDGE_PREOPEN_RAD),),
    shelf_region=SHELF_REGION,
    # As in the original: the way begins within 2 m of where the last object was put
    # (mshab/utils/gen/gen_spawn_positions.py).
    departs_from_last_goal=True,
)
