"""Instructions: every kind and task has several wordings, and they say what is where."""

from __future__ import annotations

import numpy as np
import pytest

from mjhab.core.errors import UsageError
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.instructions import (
    CARRY_WORDINGS,
    Request,
    Spot,
    instructions,
    seeded_draw,
    subtask_instruction,
    target_words,
    task_instruction,
)
from mjhab.tasks.plan import GOAL_OF
from mjhab.tasks.subtasks.registry import SUBTASKS

CAN = "005_tomato_soup_can_:0002"
TABLE = Spot("table_02")
FRIDGE = Spot("fridge", inside=True)


@pytest.mark.parametrize(
    ("request_", "sentence"),
    [
        (Request("pick", CAN, TABLE), "pick up the soup can from the coffee table"),
        (Request("pick", CAN), "pick up the soup can"),
        (Request("place", CAN, TABLE, FRIDGE), "put the soup can in the fridge"),
        (Request("place", CAN), "put the soup can at its goal"),
        (Request("navigate", CAN, TABLE), "go to the soup can on the coffee table"),
        (Request("navigate", "fridge/top_door"), "go to the fridge"),
        (
            Request("navigate", GOAL_OF + CAN, TABLE, FRIDGE),
            "carry the soup can to the fridge",
        ),
        (Request("navigate", GOAL_OF + CAN), "carry the soup can to its goal"),
        (
            Request("open", "kitchen_counter/drawer3"),
            "open drawer 3 of the kitchen counter",
        ),
        (Request("close", "fridge/top_door"), "close the fridge"),
    ],
)
def test_first_wordings(request_: Request, sentence: str) -> None:
    assert subtask_instruction(request_) == sentence


def test_every_kind_and_task_has_several_wordings() -> None:
    specs = (*SUBTASKS.values(), *TASKS.values())
    for wordings in (*(spec.words for spec in specs), CARRY_WORDINGS):
        assert len(set(wordings)) == len(wordings) >= 2


def test_a_chain_says_what_goes_where_in_order() -> None:
    requests = [
        Request("pick", CAN, TABLE),
        Request("place", CAN, TABLE, FRIDGE),
        Request("place", "024_bowl_:0000", FRIDGE, Spot("sofa")),
    ]
    sentence = task_instruction("tidy_house", requests)
    expected = (
        "tidy up the house: put the soup can in the fridge, then put the bowl on the sofa"
    )
    assert sentence == expected
    drawn = [
        instructions(
            "tidy_house", requests, False, seeded_draw(np.random.default_rng(seed))
        )
        for seed in range(40)
    ]
    assert len({one.task for one in drawn}) > 3
    assert len({one.subtasks for one in drawn}) > 3
    assert all("{" not in text for one in drawn for text in (one.task, *one.subtasks))
    alone = instructions("tidy_house", requests[:1], True, lambda count: count - 1)
    assert (
        alone.task
        == alone.subtasks[0]
        == "grab the tomato soup can from the coffee table"
    )


def test_things_without_words_of_their_own_are_called_by_their_id() -> None:
    assert target_words("024_bowl_:0003") == "the bowl"
    assert target_words("cabinet/left_door") == "the left door of the cabinet"
    with pytest.raises(UsageError, match="unknown subtask 'wipe'"):
        subtask_instruction(Request("wipe", CAN))
    with pytest.raises(UsageError, match="unknown task 'wash'"):
        task_instruction("wash", [])
