"""Instructions are true and fit one thing only: read back against the state, not by the code that writes them.

`check_sentences.py` does the same for a thousand episodes of every task and pack.
"""

from __future__ import annotations

import pytest

from mjhab.envs.parts.reporting import describe_episode
from mjhab.tasks.household.registry import TASKS
from tests.examples.plugins import loaded
from tests.real_data import real_data
from tests.sentences.check_sentences import HOUSEHOLD, Checker, rows, wrong
from tests.sentences.reader import Reader, check_episode

EPISODES = 6


@pytest.mark.parametrize("task", HOUSEHOLD)
def test_sentences_of_built_in_homes_are_true(task: str) -> None:
    (row,) = rows(EPISODES, "builtin", (task,), seed=1)
    assert not wrong(row), row["examples"]
    assert row["counts"]["chain"]["true"] > EPISODES * TASKS[task].length


@pytest.mark.parametrize("task", HOUSEHOLD)
def test_sentences_of_scanned_homes_are_true(task: str) -> None:
    (row,) = rows(EPISODES // 2, str(real_data("replica_cad")), (task,), seed=1)
    assert not wrong(row), row["examples"]


def test_sentences_of_a_plugin_are_true() -> None:
    with loaded("push"):
        (row,) = rows(EPISODES, "builtin", ("push_objects",))
        assert not wrong(row), row["examples"]
        assert row["counts"]["push"]["true"] == EPISODES // 2


HARD = [
    # Two equal objects 6 mm apart by what they were told by; none that was nearest to anything before and after.
    ("builtin", 187),
    ("builtin", 223),
    ("builtin", 357),
    # One of the others moves within the place: it was counted twice ("rightmost" of two).
    ("replica_cad", 357),
]


@pytest.mark.parametrize(("pack", "index"), HARD)
def test_equal_objects_that_the_plan_moves_are_told_apart(pack: str, index: int) -> None:
    checker = Checker("tidy_house", pack if pack == "builtin" else str(real_data(pack)))
    found = checker.check(0, index)
    assert not any(each.examples for each in found.values()), found


LIES = [
    # What was said of every bowl in a drawer, while other bowls stand on the worktop.
    ("top right drawer", "right part", "false"),
    ("top right drawer", "top left drawer", "false"),
    ("top right drawer", "bottom right drawer", "false"),
    ("top right drawer of the ", "", "ambiguous"),
    ("second highest shelf", "top shelf", "false"),
    ("dining table", "coffee table", "false"),
    ("apple", "soup can", "false"),
    ("in the top", "on the top", "false"),
    ("top door", "bottom door", "false"),
    ("top right drawer", "drawer 3", "unread"),
    ("top right drawer", "right drawer", "ambiguous"),
    ("the apple", "the left apple", "false"),
]


@pytest.mark.parametrize(("said", "instead", "outcome"), LIES)
def test_the_reader_finds_lies(
    set_table: Checker, said: str, instead: str, outcome: str
) -> None:
    config, source = set_table.source("", "train")
    episode = source.episode(0, 0)
    start = source.start(episode)
    told = dict(describe_episode(episode, start.plan, config, set_table.narrator))
    lies = tuple(text.replace(said, instead) for text in told["instructions"])
    reader = Reader(
        source.layout, set_table.sim.model(start.home), start.qpos, start.home
    )
    names = TASKS["set_table"].words
    found = check_episode(reader, start.plan, told | {"instructions": lies}, names)
    assert found.counts[outcome] > 0, found
    assert not check_episode(reader, start.plan, told, names).examples


@pytest.fixture(scope="module")
def set_table() -> Checker:
    return Checker("set_table", "builtin")
