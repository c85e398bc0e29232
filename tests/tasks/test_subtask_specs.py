"""Specs of subtasks and tasks: what is refused, and that an unknown kind is an error wherever one comes up."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mjhab
from mjhab.tasks.household.registry import TASKS, task_with
from mjhab.tasks.household.spec import TargetRule, TaskSpec
from mjhab.tasks.label_state import WATCHED, fold
from mjhab.tasks.labelling.events import edge_events
from mjhab.tasks.labelling.labels import label
from mjhab.tasks.labelling.legacy import legacy_label
from mjhab.tasks.plan import Subtask, SubtaskKind
from mjhab.tasks.scoring import DenseReward, reward_table
from mjhab.tasks.subtasks.pick import PICK
from mjhab.tasks.subtasks.registry import (
    SUBTASKS,
    name_of,
    number_of,
    properties,
    register_subtask,
    spec_of,
)
from mjhab.tasks.subtasks.spec import LabelRule, SubtaskSpec
from mjhab.tasks.thresholds import SubtaskConfig
from tests.refusals import refused
from tests.tasks.build import CONFIG, history

SPARE: dict[str, Any] = {
    "words": ("stare at {object}",),
    "conditions": ("is_static", "force_ok"),
    "label_rules": (
        LabelRule("stare_success", lambda s: s.ever("success")),
        LabelRule("stare_failure"),
    ),
    "start": "mjhab.episodes.starts.pick:START",
}
"""All that a subtask needs but a name."""


def rules(when: Callable[[Any], Any]) -> dict[str, Any]:
    """Label rules with a condition."""
    return {"label_rules": (LabelRule("a", when), LabelRule("b"))}


@pytest.fixture
def stare() -> Iterator[SubtaskSpec]:
    """A subtask of the calling program, without reward, expert and published labels."""
    spec = register_subtask(SubtaskSpec(name="stare", **SPARE))
    yield spec
    SUBTASKS.remove("stare")


def test_numbers_are_those_of_the_original() -> None:
    assert [number_of(kind.name.lower()) for kind in SubtaskKind] == list(SubtaskKind)
    assert [name_of(kind) for kind in SubtaskKind] == list(SUBTASKS)
    for name, spec in zip(SUBTASKS, SUBTASKS.values(), strict=True):
        assert spec.name == name


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"label_rules": ()}, dict(option="label_rules", where="subtask 'stare'")),
        ({"conditions": ()}, dict(option="conditions")),
        ({"conditions": (), "label_rules": ()}, dict(option="conditions")),
        ({"words": (), "start": None}, dict(option="words")),
        ({"start": None}, dict(option="start")),
        ({"words": "stare at {object}"}, dict(option="words", given="stare at {object}")),
        ({"conditions": "is_static"}, dict(option="conditions", given="is_static")),
        (
            {"words": ("grab {thing}",)},
            dict(option="placeholder of the wording 'grab {thing}':", given="thing"),
        ),
        (
            {"words": ("grab {}",)},
            dict(option="placeholder of the wording 'grab {}':", given=""),
        ),
        (
            {"words": ("grab {object",)},
            dict(said="the wording 'grab {object' cannot be read"),
        ),
        (
            rules(lambda s: s.ever("sucess")),
            dict(
                where="subtask 'stare': label rule 'a'",
                said="label rule 'a': unknown signal 'sucess'. Did you",
            ),
        ),
        (
            rules(lambda s: s.holds("released")),
            dict(
                where="subtask 'stare': label rule 'a'",
                said="label rule 'a': unknown signal 'released'.",
            ),
        ),
        (rules(lambda s: s.nothing), dict(where="subtask 'stare': label rule 'a'")),
        (
            rules(lambda s: True),
            dict(
                where="subtask 'stare': label rule 'a'",
                said="must give one bool per world, shape (W,), as LabelState.ever",
            ),
        ),
        (
            rules(lambda s: 1.0 * s.ever("success")),
            dict(
                where="subtask 'stare': label rule 'a'", said="got float64 of shape (2,)"
            ),
        ),
        ({"conditions": ("is_statik",)}, dict(option="check", given="is_statik")),
        ({"events": ("sucess",)}, dict(option="event", given="sucess")),
        ({"edges": {"success": "+sucess"}}, dict(option="edge", given="+sucess")),
        ({"edges": {"stared": "+success"}}, dict(option="event", given="stared")),
        ({"shows": ("goals",)}, dict(option="observation", given="goals")),
        ({"measures": {"at_goal": 3}}, dict(option="the measure of 'at_goal'", given=3)),
        ({"measures": {"at_gaol": max}}, dict(option="check", given="at_gaol")),
        ({"color": "red"}, dict(option="color", given="red")),
        ({"about": "thing"}, dict(option="about", given="thing")),
        ({"label_rules": SPARE["label_rules"][:1]}, dict(option="label_rules")),
        ({"label_rules": SPARE["label_rules"][::-1]}, dict(option="label_rules")),
        (
            {"label_rules": (SPARE["label_rules"][0], LabelRule("stare_success"))},
            dict(option="labels", given=("stare_success", "stare_success")),
        ),
        ({"name": "Stare!"}, dict(option="name of a subtask", given="Stare!")),
        ({"name": 3}, dict(option="name", given=3)),
        ({"color": 3}, dict(option="color", given=3)),
        ({"limits": 200}, dict(option="limits", given=200)),
        ({"limits": SubtaskConfig(0, 100.0)}, dict(option="horizon of limits", given=0)),
        (
            {"limits": SubtaskConfig(200, 0.0)},
            dict(option="force_limit of limits", given=0.0),
        ),
        ({"train_horizon": "long"}, dict(option="train_horizon", given="long")),
        ({"train_horizon": -1}, {"option": "train_horizon", "given": -1}),
        ({"measures": ["at_goal"]}, dict(option="measures", given=["at_goal"])),
        ({"edges": ("success",)}, dict(option="edges", given=("success",))),
        (
            {"label_rules": ("done", "failed")},
            dict(option="label_rules[0]", given="done"),
        ),
        ({"reward": "dense"}, dict(option="reward", given="dense")),
        ({"published": ("done",)}, dict(option="published", given=("done",))),
        ({"keeps_goal": "no"}, dict(option="keeps_goal", given="no")),
    ],
)
def test_a_subtask_that_lacks_something_is_refused(
    changes: dict[str, Any], told: dict[str, Any]
) -> None:
    with refused(**told):
        SubtaskSpec(**{"name": "stare", **SPARE, **changes})


def test_two_subtasks_or_tasks_of_one_name_are_refused() -> None:
    with refused("subtask", "pick", expected="registered once"):
        mjhab.register_subtask(PICK)
    with refused("task", "set_table", expected="registered once"):
        mjhab.register_task(TASKS["set_table"])


def test_what_a_spec_leaves_out_is_told_when_it_is_asked_for(stare: SubtaskSpec) -> None:
    kind = number_of("stare")
    assert spec_of(kind) is stare and kind == len(SubtaskKind)
    assert legacy_label(kind, ["success"], True) is None
    assert DenseReward(CONFIG).score is not None
    with refused("reward_mode", "dense"):
        DenseReward(CONFIG, kinds=["stare"])
    with refused("reward_mode", "dense"):
        reward_table("stare")
    with refused(said="no task has the subtask 'stare'"):
        task_with("stare")
    with refused("subtask", "stare"):
        mjhab.make(task="set_table", subtask="stare")
    kinds = np.array([kind, -1, 2])
    assert (
        properties(kinds, "navigates", "may_hold").tolist() == [[False, False, True]] * 2
    )


def test_tables_grow_and_shrink_with_the_registry() -> None:
    spec = register_subtask(SubtaskSpec(name="stare", **SPARE))
    assert properties(np.array([5]), "jointed").shape == (1, 1) and spec.name in SUBTASKS
    SUBTASKS.remove("stare")
    with refused("number of a subtask", 5):
        properties(np.array([5]), "jointed")


UNKNOWN: dict[str, Callable[[], object]] = {
    "name": lambda: name_of(5),
    "spec": lambda: spec_of(-1),
    "target": lambda: Subtask(7, "bowl").target,
    "label": lambda: label(fold(history(steps=2)), np.array([5])),
    "events": lambda: edge_events(np.array([5]), *np.zeros((2, len(WATCHED), 1), bool)),
    "legacy": lambda: legacy_label(5, [], False),
    "reward": lambda: reward_table("pik"),
    "task": lambda: mjhab.make(task="set_tabel"),
    "subtask": lambda: mjhab.make(task="set_table", subtask="clos"),
}


@pytest.mark.parametrize("where", UNKNOWN)
def test_an_unknown_kind_is_an_error(where: str) -> None:
    with refused(
        "subtask"
        if where in ("reward", "subtask")
        else "task"
        if where == "task"
        else "number of a subtask"
    ):
        UNKNOWN[where]()


@pytest.mark.parametrize(
    ("changes", "option"),
    [
        ({"targets": ()}, "targets"),
        ({"words": "idle"}, "words"),
        ({"objects": "024_bowl"}, "objects"),
        ({"targets": ({"start": ()},)}, "targets[0]"),
        ({"words": (), "targets": ()}, "words"),
        ({"name": "no name"}, "name of a task"),
        ({"name": 3}, "name"),
        ({"targets": 3}, "targets"),
        ({"clutter_copies": -1}, "clutter_copies"),
        ({"clutter_copies": 1.5}, "clutter_copies"),
        ({"openings": {"fridge_door": 1.5}}, "openings"),
        ({"openings": (("fridge_door", "wide"),)}, "openings"),
        ({"shelf_region": 0.0}, "shelf_region"),
        ({"departs_from_last_goal": 1}, "departs_from_last_goal"),
    ],
)
def test_a_task_that_lacks_something_is_refused(
    changes: dict[str, Any], option: str
) -> None:
    rule = TargetRule(start=("sink",), goal=("sink",))
    with refused(option):
        TaskSpec(**{"name": "idle", "words": ("idle",), "targets": (rule,), **changes})


@pytest.mark.parametrize(
    ("changes", "option"),
    [
        ({"object": 3}, "object"),
        ({"chain": "pick"}, "chain"),
        ({"distance_m": 2.0}, "distance_m"),
        ({"distance_m": (2.0, 0.5)}, "distance_m"),
        ({"distance_m": (-1.0, 0.5)}, "distance_m"),
    ],
)
def test_a_rule_with_a_wrong_value_is_refused(
    changes: dict[str, Any], option: str
) -> None:
    with refused(option, where="a TargetRule"):
        TargetRule(**{"start": ("sink",), "goal": ("sink",), **changes})


def test_a_rule_that_opens_names_the_link() -> None:
    rule = TASKS["set_table"].targets[0]
    with refused("link", ""):
        replace(rule, link="")
    with refused(given="strat", expected="start"):
        replace(rule, opens="strat")  # type: ignore[arg-type]


def test_a_plan_with_an_unknown_subtask_is_refused_when_it_is_registered() -> None:
    rule = TargetRule(
        ("sink",), ("sink",), chain=lambda target: [Subtask(number_of("hop"))]
    )
    with refused("subtask", "hop"):
        mjhab.register_task(TaskSpec(name="hopping", words=("hop",), targets=(rule,)))
    assert "hopping" not in TASKS
