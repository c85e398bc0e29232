"""Specs of subtasks and tasks: what is refused, and that an unknown kind is an error wherever one comes up."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mjhab
from mjhab.core.errors import UsageError
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
    ("changes", "said"),
    [
        ({"label_rules": ()}, "subtask 'stare' has no label_rules;"),
        ({"conditions": ()}, "has no conditions;"),
        ({"conditions": (), "label_rules": ()}, "has no conditions and no label_rules;"),
        ({"words": (), "start": None}, "has no words and no start; give words=("),
        (
            {"start": None},
            "give start=, an object of a subclass of mjhab.episodes.starts.Sub",
        ),
        ({"words": "stare at {object}"}, "words must be a tuple of texts"),
        ({"conditions": "is_static"}, "conditions must be a tuple of texts"),
        ({"words": ("grab {thing}",)}, "of the wording 'grab {thing}': 'thing'. "),
        ({"words": ("grab {}",)}, "of the wording 'grab {}': ''. "),
        ({"words": ("grab {object",)}, "the wording 'grab {object' cannot be read"),
        (
            rules(lambda s: s.ever("sucess")),
            "label rule 'a': unknown signal 'sucess'. Did you",
        ),
        (
            rules(lambda s: s.holds("released")),
            "label rule 'a': unknown signal 'released'.",
        ),
        (rules(lambda s: s.nothing), "label rule 'a' raised AttributeError"),
        (
            rules(lambda s: True),
            "must give one bool per world, shape (W,), as LabelState.ever",
        ),
        (rules(lambda s: 1.0 * s.ever("success")), "got float64 of shape (2,)"),
        ({"conditions": ("is_statik",)}, "Did you mean 'is_static'"),
        ({"events": ("sucess",)}, "Did you mean 'success'"),
        ({"edges": {"success": "+sucess"}}, "subtask 'stare': unknown edge '+sucess'"),
        ({"edges": {"stared": "+success"}}, "subtask 'stare': unknown event 'stared'"),
        ({"shows": ("goals",)}, "Did you mean 'goal'"),
        ({"measures": {"at_goal": 3}}, "the measure of 'at_goal' must be a function"),
        (
            {"measures": {"at_gaol": max}},
            "subtask 'stare': unknown check 'at_gaol'. Did you mean 'at_goal'",
        ),
        ({"color": "red"}, "like '#3b82f6'"),
        ({"about": "thing"}, "subtask 'stare': unknown about 'thing'"),
        (
            {"label_rules": SPARE["label_rules"][:1]},
            "the last, and no other, is without a condition",
        ),
        (
            {"label_rules": SPARE["label_rules"][::-1]},
            "the last, and no other, is without a condition",
        ),
        (
            {"label_rules": (SPARE["label_rules"][0], LabelRule("stare_success"))},
            "labels must be different",
        ),
        ({"name": "Stare!"}, "lower-case"),
        ({"name": 3}, "subtask 3: name must be a text, got 3"),
        ({"color": 3}, "subtask 'stare': color must be a text"),
        ({"limits": 200}, "limits must be a SubtaskConfig, got 200"),
        ({"limits": SubtaskConfig(0, 100.0)}, "horizon of limits must be a whole number"),
        ({"limits": SubtaskConfig(200, 0.0)}, "force_limit of limits must be a number"),
        ({"train_horizon": "long"}, "train_horizon must be a whole number or None"),
        ({"train_horizon": -1}, "train_horizon must be a whole number of control steps"),
        ({"measures": ["at_goal"]}, "measures must be a mapping"),
        ({"edges": ("success",)}, "edges must be a mapping"),
        ({"label_rules": ("done", "failed")}, "label_rules[0] must be a LabelRule"),
        ({"reward": "dense"}, "reward must be a RewardTable or None"),
        ({"published": ("done",)}, "published must be a PublishedLabels or None"),
        ({"keeps_goal": "no"}, "keeps_goal must be True or False"),
    ],
)
def test_a_subtask_that_lacks_something_is_refused(
    changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(UsageError) as error:
        SubtaskSpec(**{"name": "stare", **SPARE, **changes})
    assert said in str(error.value)


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
    with pytest.raises(UsageError, match="'stare' has no dense reward"):
        DenseReward(CONFIG, kinds=["stare"])
    with pytest.raises(UsageError, match="'stare' has no dense reward"):
        reward_table("stare")
    with pytest.raises(UsageError, match="no task has the subtask 'stare'"):
        task_with("stare")
    with pytest.raises(UsageError, match="'stare' belongs to: no task"):
        mjhab.make(task="set_table", subtask="stare")
    kinds = np.array([kind, -1, 2])
    assert (
        properties(kinds, "navigates", "may_hold").tolist() == [[False, False, True]] * 2
    )


def test_tables_grow_and_shrink_with_the_registry() -> None:
    spec = register_subtask(SubtaskSpec(name="stare", **SPARE))
    assert properties(np.array([5]), "jointed").shape == (1, 1) and spec.name in SUBTASKS
    SUBTASKS.remove("stare")
    with pytest.raises(UsageError, match="no subtask with the number 5"):
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
    with pytest.raises(UsageError, match=r"no subtask with the number|Did you mean"):
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
