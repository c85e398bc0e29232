"""The example of a new subtask, end to end and by its parts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mjhab.core.arrays import map_record
from mjhab.tasks.labelling.labels import label_history, label_names
from mjhab.tasks.measure import measure
from mjhab.tasks.plan import Subtask, TaskPlan, stack_plans
from mjhab.tasks.progress import start
from mjhab.tasks.scoring import DenseReward
from mjhab.tasks.signals import Signals, WorldState
from mjhab.tasks.subtasks.registry import SUBTASKS, event_columns, number_of, spec_of
from tests.examples.plugins import loaded, run
from tests.tasks.build import CONFIG, history, resting, to_torch

GOAL = (1.0, 0.0, 0.5)


@pytest.fixture(autouse=True)
def push() -> Iterator[None]:
    with loaded("push"):
        yield


def signals_of(state: WorldState) -> Signals:
    plan = stack_plans(
        [TaskPlan("test", (Subtask(number_of("push"), "can", goal_pos=GOAL),))], CONFIG
    )
    if isinstance(state.base_pose, torch.Tensor):
        plan = map_record(torch.from_numpy, replace(plan, goal_rect=None))
    return measure(state, plan, start(plan, CONFIG), CONFIG)


def test_a_push_is_from_its_environment_to_its_report(tmp_path: Path) -> None:
    program = Path(__file__).with_name("push_program.py")
    assert "all of Push works" in run("push", program, str(tmp_path))


def test_the_zone_is_narrower_than_the_goal_of_a_place() -> None:
    for distance, inside in ((0.0, True), (0.07, True), (0.09, False), (0.14, False)):
        state = resting(1, plan_obj_pos=np.array([[[1.0 + distance, 0.0, 0.5]]]))
        for signals in (signals_of(state), signals_of(to_torch(state))):
            assert bool(signals.at_goal[0]) == bool(signals.success[0]) == inside
    fallen = resting(1, plan_obj_pos=np.array([[[1.0, 0.0, 0.4]]]))
    assert not signals_of(fallen).success[0]


LABELS = {
    "success_then_excessive_collisions": history(
        at_goal="0111", success="0010", force_ok="1110"
    ),
    "success_then_left_zone": history(at_goal="0110", success="0010"),
    "push_success": history(at_goal="0011", success="0001"),
    "excessive_collision_failure": history(ee_contact="0111", force_ok="1110"),
    "didnt_touch_failure": history(steps=4),
    "left_zone_failure": history(ee_contact="0110", at_goal="0110"),
    "too_slow_failure": history(ee_contact="0110", at_goal="0011"),
    "short_of_zone_failure": history(ee_contact="0110"),
}


@pytest.mark.parametrize("label", LABELS)
def test_every_label_has_its_history(label: str) -> None:
    kind = np.array([number_of("push")])
    assert set(LABELS) == set(SUBTASKS["push"].labels)
    assert label_names(kind, label_history(kind, LABELS[label])) == [label]


def test_it_is_the_sixth_kind_with_columns_of_its_own() -> None:
    assert number_of("push") == 5 and spec_of(5).name == "push"
    assert event_columns()[-3:] == ("touched", "entered_zone", "left_zone")
    assert DenseReward(CONFIG, kinds=["push"]).names == (
        "reach",
        "push",
        "in_zone",
        "rest",
        "force",
        "success",
    )
