"""Plans: chains of the three tasks, arrays, areas in front of furniture, thresholds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mjhab.tasks.household.registry import chain
from mjhab.tasks.plan import (
    PADDING,
    Subtask,
    SubtaskKind,
    Target,
    TaskPlan,
    stack_plans,
)
from mjhab.tasks.subtasks.registry import force_limits, horizons
from tests.refusals import refused
from tests.tasks.build import CONFIG, config_of

BOWL = Target(
    "bowl",
    (4, 1, 0.8),
    (1, 0, 0.9),
    start_link="kitchen_counter/drawer3",
    handle_pos=(1.3, 0, 0.9),
)
APPLE = Target(
    "apple",
    (4, 2, 0.8),
    (0, 3, 1.2),
    start_link="fridge/top_door",
    handle_pos=(0.4, 3, 1.2),
)


def kinds(plan: TaskPlan) -> list[str]:
    return [s.name for s in plan.subtasks]


def test_set_table_opens_fetches_places_and_closes_for_both_objects() -> None:
    plan = chain("set_table", [BOWL, APPLE], home="builtin_m0_00")
    once = [
        "navigate",
        "open",
        "navigate",
        "pick",
        "navigate",
        "place",
        "navigate",
        "close",
    ]
    assert kinds(plan) == once * 2
    assert plan.home == "builtin_m0_00"
    targets = [s.target for s in plan.subtasks[:8]]
    drawer = "kitchen_counter/drawer3"
    assert targets == [
        drawer,
        drawer,
        "bowl",
        "bowl",
        "goal of bowl",
        "bowl",
        drawer,
        drawer,
    ]
    assert plan.subtasks[1].goal_pos == BOWL.handle_pos and plan.subtasks[1].obj == "bowl"
    assert plan.subtasks[7].obj == ""
    assert [s.must_hold for s in plan.subtasks[:8]] == [False] * 4 + [True] + [False] * 3
    assert plan.subtasks[4].goal_pos == plan.subtasks[5].goal_pos == BOWL.goal_pos
    assert plan.indices(SubtaskKind.CLOSE) == (7, 15)
    assert (
        kinds(plan.only(9)) == ["open"]
        and plan.only(9).subtasks[0].link == "fridge/top_door"
    )


@pytest.mark.parametrize(("task", "count"), [("tidy_house", 5), ("prepare_groceries", 3)])
def test_tidying_repeats_pick_and_place(task: str, count: int) -> None:
    plan = chain(task, [Target(f"o{i}", (i, 0, 1), (0, i, 1)) for i in range(count)])
    assert kinds(plan) == ["navigate", "pick", "navigate", "place"] * count
    assert plan.subtasks[4].goal_pos == (0, 1, 1), "walk to where the object is"
    assert plan.subtasks[4].obj == "", "nothing in the hand yet"


def test_wrong_plans_say_what_is_expected() -> None:
    with refused("task", "settable", expected="set_table"):
        chain("settable", [])
    with refused("number of targets of tidy_house", 6, expected="1 to 5"):
        chain("tidy_house", [BOWL, APPLE] * 3)
    with refused("start_link"):
        chain("set_table", [BOWL, Target("pear", (0, 0, 0))])


def test_thresholds_are_those_of_the_paper() -> None:
    assert horizons(CONFIG) == (200, 200, 500, 200, 200)
    assert force_limits(CONFIG) == (5000, 7500, math.inf, 10000, 10000, math.inf)
    assert CONFIG.open_fraction(hinged=True) == 0.75
    assert CONFIG.open_fraction(hinged=False) == 0.9
    with refused("rest_qpos", expected="15 joint values"):
        config_of((0.0,) * 12)
    with refused("goal_type", "circle", expected="sphere"):
        config_of(goal_type="circle")  # type: ignore[arg-type]


def test_stacked_plans_are_padded_to_the_longest() -> None:
    long = chain("set_table", [BOWL, APPLE])
    short = TaskPlan("x", (Subtask(SubtaskKind.PICK, "bowl"),))
    box = (0.0, 1.0, -1.0, 1.0)
    boxes = [{"fridge/top_door": box}, {}]
    plan = stack_plans(
        [long, short], CONFIG, boxes, min_subtasks=20, doors={"fridge/top_door"}
    )
    assert plan.kind.shape == (2, 20) and plan.kind.dtype == np.int64
    assert plan.length.tolist() == [16, 1]
    assert (plan.kind[0, 16:] == PADDING).all() and (plan.kind[1, 1:] == PADDING).all()
    assert plan.open_frac[0, 1] == 0.9 and plan.open_frac[0, 9] == 0.75
    assert plan.must_hold[0].nonzero()[0].tolist() == [4, 12]
    boxed = ~np.isnan(plan.box[..., 0])
    assert boxed[0].nonzero()[0].tolist() == [8, 10, 14], "to the fridge with empty hands"
    assert not boxed[1].any() and plan.box[0, 8].tolist() == list(box)
    assert plan.goal_rect is None
