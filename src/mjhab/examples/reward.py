"""A reward of your own: Pick as mjhab has it, but paid for a soft grip.

    MJHAB_PLUGINS=examples/reward.py mjhab envs describe mjhab/GentlePickSubtaskTrain-v1
    MJHAB_PLUGINS=examples/reward.py mjhab train ppo --task clear_counter --subtask gentle_pick --budget-minutes 20

The terms of Pick are kept and one is added. Success, start, labels and expert are Pick's. If only the scales of terms
are to be others, `mjhab.make_train(subtask="pick", reward_scales={"pick": {"reach": 4.0}})` needs no file.
"""

from __future__ import annotations

import dataclasses

from mjhab import TargetRule, TaskSpec, register_subtask, register_task
from mjhab.core.arrays import Array
from mjhab.tasks.plan import Subtask, Target
from mjhab.tasks.rewards.table import RewardView, Term
from mjhab.tasks.subtasks.pick import PICK, REWARD
from mjhab.tasks.subtasks.registry import number_of
from mjhab.tasks.thresholds import TaskConfig

SOFT_N = 60.0
"""Force on both fingers together that costs half of the term: enough to hold what there is to pick."""


def soft_grip(
    view: RewardView, config: TaskConfig
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Conditions and raw values (W,) of Pick's terms, and of the new one."""
    when, raw = REWARD.raw(view, config)
    raw["soft"] = 1.0 / (1.0 + view.world.fingers_force / SOFT_N)
    return when, raw


# "grasped" is a condition that Pick's table has already.
SOFT = Term("soft", 3.0, "grasped", "force on the fingers: 1 / (1 + F / 60 N)")
GENTLE_PICK = dataclasses.replace(
    PICK,
    name="gentle_pick",
    words=("gently pick up {object} {source}", "take {object} {source} with care"),
    reward=dataclasses.replace(REWARD, terms=(*REWARD.terms, SOFT), raw=soft_grip),
)


def go_and_pick(target: Target) -> list[Subtask]:
    """Drive to the object, pick it."""
    return [
        Subtask(number_of("navigate"), goal_pos=target.start_pos, toward=target.obj),
        Subtask(number_of("gentle_pick"), obj=target.obj, link=target.start_link),
    ]


CLEAR_COUNTER = TaskSpec(
    name="clear_counter",
    words=("clear the counter",),
    targets=(TargetRule(("counter_top",), ("sink",), chain=go_and_pick),),
)

register_subtask(GENTLE_PICK)
register_task(CLEAR_COUNTER)
