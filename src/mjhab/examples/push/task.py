"""A household task that has the subtask Push: small things on the dining table are pushed into their zones."""

from __future__ import annotations

from mjhab.tasks.household.spec import TargetRule, TaskSpec
from mjhab.tasks.plan import Subtask, Target
from mjhab.tasks.subtasks.registry import number_of

NUM_OBJECTS = 2
_TABLE = ("dining_table",)


def go_and_push(target: Target) -> list[Subtask]:
    """Navigate to the object, push it into its zone."""
    return [
        Subtask(number_of("navigate"), goal_pos=target.start_pos, toward=target.obj),
        Subtask(number_of("push"), obj=target.obj, goal_pos=target.goal_pos),
    ]


PUSH_OBJECTS = TaskSpec(
    name="push_objects",
    words=("sort the things on the table", "tidy the table top"),
    targets=(TargetRule(_TABLE, _TABLE, distance_m=(0.15, 0.3), chain=go_and_push),)
    * NUM_OBJECTS,
    objects=("007_tuna_fish_can", "008_pudding_box", "010_potted_meat_can"),
    clutter_copies=0,
)
