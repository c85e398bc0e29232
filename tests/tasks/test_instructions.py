"""Instructions: every kind and task has several wordings, and they say what is where."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest

from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.instructions import (
    CARRY_WORDINGS,
    InstructionRequest,
    Spot,
    instructions,
    seeded_draw,
    subtask_instruction,
    target_words,
    task_instruction,
    without_teleport_mark,
)
from mjhab.tasks.plan import GOAL_OF
from mjhab.tasks.subtasks.registry import SUBTASKS
from tests.refusals import refused

CAN = "005_tomato_soup_can_:0002"
TABLE = Spot("the coffee table")
FRIDGE = Spot("the second highest shelf of the fridge")
DRAWER = Spot("the top right drawer of the kitchen counter", "in")
CALLED = ("top right drawer of the kitchen counter",)


@pytest.mark.parametrize(
    ("request_", "sentence"),
    [
        (
            InstructionRequest("pick", CAN, TABLE),
            "pick up the soup can from the coffee table",
        ),
        (InstructionRequest("pick", CAN), "pick up the soup can"),
        (
            InstructionRequest("pick", CAN, DRAWER),
            "pick up the soup can from the top right drawer of the kitchen counter",
        ),
        (
            InstructionRequest("pick", CAN, TABLE, before="left"),
            "pick up the left soup can from the coffee table",
        ),
        (
            InstructionRequest("pick", CAN, TABLE, after="nearest to the bowl"),
            "pick up the soup can nearest to the bowl from the coffee table",
        ),
        (
            # The can is in the hand: nothing else tells which one is meant.
            InstructionRequest("place", CAN, TABLE, FRIDGE, before="left"),
            "put the soup can on the second highest shelf of the fridge",
        ),
        (
            InstructionRequest("place", CAN, TABLE, DRAWER),
            "put the soup can in the top right drawer of the kitchen counter",
        ),
        (InstructionRequest("place", CAN), "put the soup can at its goal"),
        (
            InstructionRequest("navigate", CAN, TABLE),
            "go to the soup can on the coffee table",
        ),
        (
            InstructionRequest("navigate", CAN, DRAWER, before="left"),
            "go to the left soup can in the top right drawer of the kitchen counter",
        ),
        (
            InstructionRequest("navigate", "fridge/top_door"),
            "go to the top door of the fridge",
        ),
        (
            InstructionRequest("navigate", GOAL_OF + CAN, TABLE, FRIDGE),
            "carry the soup can to the second highest shelf of the fridge",
        ),
        (InstructionRequest("navigate", GOAL_OF + CAN), "carry the soup can to its goal"),
        (
            InstructionRequest("open", "kitchen_counter/drawer3", names=CALLED),
            "open the top right drawer of the kitchen counter",
        ),
        (
            InstructionRequest("close", "fridge/top_door"),
            "close the top door of the fridge",
        ),
    ],
)
def test_first_wordings(request_: InstructionRequest, sentence: str) -> None:
    assert subtask_instruction(request_) == sentence


def test_every_kind_and_task_has_several_wordings() -> None:
    specs = (*SUBTASKS.values(), *TASKS.values())
    for wordings in (*(spec.words for spec in specs), CARRY_WORDINGS):
        assert len(set(wordings)) == len(wordings) >= 2


def test_a_chain_says_what_goes_where_in_order() -> None:
    requests = [
        InstructionRequest("pick", CAN, TABLE),
        InstructionRequest("place", CAN, TABLE, FRIDGE, after="nearest to the sofa"),
        InstructionRequest("place", "024_bowl_:0000", FRIDGE, Spot("the sofa")),
        InstructionRequest("place", "013_apple_:0000", TABLE, TABLE),
    ]
    sentence = task_instruction("tidy_house", requests)
    expected = (
        "tidy up the house: put the soup can nearest to the sofa from the coffee table on the second highest shelf of "
        "the fridge, then put the bowl from the second highest shelf of the fridge on the sofa, then move the apple on "
        "the coffee table to another place there"
    )
    assert sentence == expected
    drawn = [
        instructions(
            "tidy_house", requests, requests, seeded_draw(np.random.default_rng(seed))
        )
        for seed in range(40)
    ]
    assert len({one.task for one in drawn}) > 3
    assert len({one.subtasks for one in drawn}) > 3
    assert all("{" not in text for one in drawn for text in (one.task, *one.subtasks))
    alone = instructions("tidy_house", requests[:1], (), lambda count: count - 1)
    assert (
        alone.task
        == alone.subtasks[0]
        == "grab the tomato soup can from the coffee table"
    )


@pytest.fixture
def wipe() -> Iterator[None]:
    """A plugin's subtask whose wordings say nothing of where the object is."""
    spec = dataclasses.replace(
        SUBTASKS["pick"], name="wipe", words=("wipe {object}", "move {object} {goal}")
    )
    SUBTASKS.add("wipe", spec)
    yield
    SUBTASKS.remove("wipe")


def test_wordings_of_a_plugin_tell_where_the_object_is(wipe: None) -> None:
    lies = InstructionRequest("wipe", CAN, TABLE, TABLE, after="nearest to the sofa")
    assert (
        subtask_instruction(lies)
        == "wipe the soup can nearest to the sofa on the coffee table"
    )
    moved = dataclasses.replace(lies, goal=FRIDGE)

    def last(count: int) -> int:
        return count - 1

    assert subtask_instruction(moved, last) == (
        "move the tomato soup can nearest to the sofa on the coffee table to the second highest shelf of the fridge"
    )
    assert subtask_instruction(lies, last) == (
        "move the tomato soup can nearest to the sofa to another place on the coffee table"
    )


@pytest.mark.parametrize(
    ("id_", "called"),
    [
        ("024_bowl_:0003", "the bowl"),
        ("my_mug_2", "my mug"),
        ("my_mug_2_:0001", "my mug"),
        ("mug_2", "the mug"),
        ("adas_mug", "the adas mug"),
        ("redMug-03", "the red mug"),
        ("065-a_cups", "the cups"),
        ("the_blue_cup", "the blue cup"),
        ("42", "the object"),
        ("8a41c2e0b97d55", "the object"),
        ("cabinet/left_door", "the left door of the cabinet"),
        ("chestOfDrawers_01/drawer_2", "the drawer of the chest of drawers"),
    ],
)
def test_ids_become_words_without_numbers_and_with_one_article(
    id_: str, called: str
) -> None:
    assert target_words(id_) == called


def test_names_with_an_owner_keep_him() -> None:
    for name in ("my mug", "Ada's mug", "your mug"):
        owner, _, mug = name.partition(" ")
        request = InstructionRequest("pick", "mug", TABLE, names=(name,), before="left")
        assert (
            subtask_instruction(request)
            == f"pick up {owner} left {mug} from the coffee table"
        )


def test_the_mark_of_teleports_in_older_records_is_dropped() -> None:
    assert without_teleport_mark("go to the bowl (by teleport)") == "go to the bowl"
    assert without_teleport_mark("go to the bowl") == "go to the bowl"


def test_unknown_kinds_and_tasks_are_refused() -> None:
    with refused("subtask", "wipe", expected="open"):
        subtask_instruction(InstructionRequest("wipe", CAN))
    with refused("task", "wash"):
        task_instruction("wash", [])
