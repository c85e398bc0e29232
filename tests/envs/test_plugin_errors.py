"""Wrong parts of subtasks and tasks from outside: one UsageError each, naming the item, the field and the fault."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mjhab
from mjhab.episodes.starts.navigate import START
from mjhab.experts.policy import script_of
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.household.spec import TargetRule, TaskSpec
from mjhab.tasks.plan import Subtask, Target
from mjhab.tasks.subtasks.registry import SUBTASKS, number_of
from mjhab.tasks.subtasks.spec import LabelRule, SubtaskSpec
from tests.refusals import refused

STARE = SubtaskSpec(
    name="stare",
    words=("stare at {object}",),
    conditions=("at_goal", "force_ok"),
    label_rules=(LabelRule("stared"),),
    start=START,
)


def go_and_stare(target: Target) -> list[Subtask]:
    return [
        Subtask(number_of("navigate"), goal_pos=target.start_pos, toward=target.obj),
        Subtask(number_of("stare"), obj=target.obj, goal_pos=target.goal_pos),
    ]


TASK = TaskSpec(
    name="staring",
    words=("stare",),
    targets=(TargetRule(("dining_table",), ("dining_table",), chain=go_and_stare),),
    objects=("024_bowl",),
    clutter_copies=0,
)


@contextmanager
def registered(task: TaskSpec = TASK, **changes: Any) -> Iterator[None]:
    """Within the context the subtask, with changes, and the task are registered."""
    mjhab.register_subtask(replace(STARE, **changes))
    try:
        mjhab.register_task(task)
        yield
    finally:
        for registry, name in ((TASKS, task.name), (SUBTASKS, STARE.name)):
            if name in registry:
                registry.remove(name)


def with_rule(**changes: Any) -> TaskSpec:
    """The task with another rule."""
    # A spec keeps what it derived from its rules, so it is made anew.
    return TaskSpec(
        TASK.name, TASK.words, (replace(TASK.targets[0], **changes),), TASK.objects, 0
    )


def run(steps: int = 2, subtask: str = "stare") -> None:
    """Make the environment and do some steps of the expert."""
    env = mjhab.make(task="staring", subtask=subtask)
    try:
        expert = mjhab.make_expert(env)
        obs, info = env.reset(seed=0)
        for _ in range(steps):
            obs, _, _, _, info = env.step(expert.act(obs, info))
    finally:
        env.close()


def raising(view: Any) -> Any:
    yield np.zeros(13, np.float32)
    raise ValueError("no way")


def good(view: Any) -> Any:
    while True:
        yield np.zeros(13, np.float32)


FAULTS: dict[str, tuple[dict[str, Any], str, str]] = {
    "expert raises": (
        {"expert": raising},
        "expert of subtask 'stare'",
        "raised ValueError: no way",
    ),
    "expert is no generator": (
        {"expert": lambda view: 3},
        "expert of subtask 'stare'",
        "must be a generator function",
    ),
    "expert leads nowhere": (
        {"expert": "nowhere_at_all:fn"},
        "subtask 'stare': expert",
        "'nowhere_at_all:fn'",
    ),
    "expert is no function": (
        {"expert": 3},
        "subtask 'stare': expert",
        "must be a generator function",
    ),
    "start is an object": (
        {"start": object()},
        "",
        "start must be an object of a subclass",
    ),
    "start is a class": (
        {"start": type(START)},
        "",
        "the class Nav",
    ),
    "start leads nowhere": (
        {"start": "pathlib:Nothing"},
        "subtask 'stare': start",
        "'pathlib:Nothing'",
    ),
    "measure of numbers": (
        {"measures": {"at_goal": lambda state, active, config: active.goal_pos[:, 0]}},
        "subtask 'stare'",
        "must give one bool per world, shape (1,)",
    ),
    "measure of another shape": (
        {"measures": {"at_goal": lambda state, active, config: active.goal_pos > 0}},
        "subtask 'stare'",
        "got bool of shape (1, 3)",
    ),
    "measure of nothing": (
        {"measures": {"at_goal": lambda state, active, config: None}},
        "subtask 'stare'",
        "got NoneType",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_part_of_a_subtask_is_told_in_one_error(fault: str) -> None:
    changes, where, said = FAULTS[fault]
    with registered(**{"expert": good, **changes}), refused(where=where, said=said):
        run()


def pick_at_once(target: Target) -> list[Subtask]:
    return [Subtask(number_of("pick"), obj=target.obj)]


TASK_FAULTS: dict[str, tuple[Callable[[], TaskSpec], str, str]] = {
    "object outside of the roster": (
        lambda: with_rule(object="013_apple"),
        "stare",
        "targets[0]: unknown object '013_apple'",
    ),
    "no navigate before": (
        lambda: with_rule(chain=pick_at_once),
        "pick",
        "subtask 'pick' begins where the navigate before it led to, but no",
    ),
}


@pytest.mark.parametrize("fault", TASK_FAULTS)
def test_a_wrong_rule_of_a_task_is_told_in_one_error(fault: str) -> None:
    task, subtask, said = TASK_FAULTS[fault]
    told = refused(where="task 'staring'", said=said)
    with registered(task(), expert=good), told:
        run(subtask=subtask)


def test_what_is_right_runs() -> None:
    with registered(expert=good):
        run()
    assert callable(script_of("pick"))
