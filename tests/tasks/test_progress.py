"""The subtask pointer: advance, force, horizons, finished Places, continuous evaluation, partial resets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mjhab.core.arrays import map_record
from mjhab.tasks.plan import PlanArrays
from mjhab.tasks.progress import (
    Progress,
    StepOutcome,
    accumulate,
    advance,
    reset_rows,
    start,
)
from mjhab.tasks.progressive import progressive, upper_bound
from mjhab.tasks.subtasks.registry import limits_of
from mjhab.tasks.thresholds import SubtaskConfig, TaskConfig
from tests.refusals import refused
from tests.tasks.build import (
    CONFIG,
    assert_same_record,
    config_of,
    plan_of,
    signals,
    to_torch,
)

PICK, PLACE, NAVIGATE, OPEN, CLOSE = range(5)
PLAN = plan_of(NAVIGATE, PICK, PLACE)
CONTINUOUS = replace(CONFIG, continuous=True)


def step(
    progress: Progress,
    plan: PlanArrays,
    config: TaskConfig = CONFIG,
    force: float = 0.0,
    **holds: Any,
) -> Any:
    """One control step of one world with hand-made signals."""
    return advance(
        accumulate(progress, np.array([force]), np.zeros(1)),
        signals(**holds),
        plan,
        config,
    )


def true_fields(outcome: StepOutcome) -> set[str]:
    return {name for name, value in vars(outcome).items() if value[0]}


def test_a_plan_runs_through() -> None:
    progress = start(PLAN, CONFIG)
    assert progress.steps_left[0] == 500 and progress.pointer[0] == 0
    progress, outcome = step(progress, PLAN, force=10.0)
    assert true_fields(outcome) == set()
    assert (
        progress.steps_left[0],
        progress.subtask_step[0],
        progress.cumulative_force[0],
    ) == (
        499,
        1,
        10.0,
    )
    progress, outcome = step(progress, PLAN, force=4.0, success=True)
    assert true_fields(outcome) == {"advanced", "ended", "success_once", "success_at_end"}
    assert (progress.pointer[0], progress.steps_left[0], progress.subtask_step[0]) == (
        1,
        200,
        0,
    )
    assert progress.cumulative_force[0] == progress.peak_force[0] == 0.0
    assert progress.episode_step[0] == 2
    progress, outcome = step(progress, PLAN, success=True)
    progress, outcome = step(progress, PLAN, force=7.0, success=True)
    assert true_fields(outcome) == {
        "advanced",
        "success",
        "done",
        "ended",
        "success_once",
        "success_at_end",
    }
    assert progress.pointer[0] == 3 and progress.done[0]
    assert progress.cumulative_force[0] == 7.0, "kept for the record of the last subtask"


def test_peak_and_cumulative_force_of_the_ended_subtask_are_in_the_progress_before_advancing() -> (
    None
):
    progress = start(PLAN, CONFIG)
    for force in (3.0, 9.0, 1.0):
        progress = accumulate(progress, np.array([force]), np.array([4.0 + force]))
    assert progress.cumulative_force[0] == 13.0 and progress.peak_force[0] == 9.0
    assert progress.peak_finger_force[0] == 13.0, "beside the sum that limits count"


def test_horizon_counts_control_steps_and_its_last_step_may_still_succeed() -> None:
    config = config_of(limits={"navigate": SubtaskConfig(3, 1e9)})
    for last_succeeds in (False, True):
        progress = start(PLAN, config)
        for _ in range(2):
            progress, outcome = step(progress, PLAN, config)
            assert true_fields(outcome) == set()
        progress, outcome = step(progress, PLAN, config, success=last_succeeds)
        expected = {"advanced", "ended", "success_once", "success_at_end"}
        assert true_fields(outcome) == (
            expected if last_succeeds else {"timeout", "fail", "done", "ended"}
        )
        assert progress.done[0] != last_succeeds


def test_too_much_force_fails_even_a_success() -> None:
    progress, outcome = step(start(PLAN, CONFIG), PLAN, success=True, force_ok=False)
    assert true_fields(outcome) == {"force_exceeded", "fail", "done", "ended"}
    assert progress.pointer[0] == 0


def test_a_finished_place_that_is_undone_fails_the_episode() -> None:
    progress, outcome = step(start(PLAN, CONFIG), PLAN, success=True, placed_ok=False)
    assert true_fields(outcome) == {"place_broken", "fail", "done", "ended"}
    assert progress.pointer[0] == 0 and progress.done[0]


def test_a_done_world_stands_still_until_its_reset() -> None:
    progress, _ = step(start(PLAN, CONFIG), PLAN, force_ok=False, force=5.0)
    after, outcome = step(progress, PLAN, force=99.0, success=True)
    assert true_fields(outcome) == set()
    for name, value in vars(progress).items():
        np.testing.assert_array_equal(getattr(after, name), value, err_msg=name)
    fresh = reset_rows(after, np.array([True]), plan_of(OPEN, CLOSE, PICK), CONFIG)
    assert (
        not fresh.done[0]
        and fresh.steps_left[0] == 200
        and fresh.cumulative_force[0] == 0.0
    )


def test_partial_reset_leaves_other_rows_bit_identical() -> None:
    plan = map_record(lambda x: np.repeat(x, 4, axis=0), PLAN)
    rng = np.random.default_rng(0)
    progress = replace(
        start(plan, CONFIG),
        cumulative_force=rng.random(4),
        pointer=np.array([0, 1, 2, 3]),
    )
    new = reset_rows(progress, np.array([False, True, False, True]), plan, CONFIG)
    assert new.pointer.tolist() == [0, 0, 2, 0]
    assert (
        new.cumulative_force[[0, 2]].tobytes()
        == progress.cumulative_force[[0, 2]].tobytes()
    )
    assert progress.pointer.tolist() == [0, 1, 2, 3], "nothing is changed in place"


def test_continuous_evaluation_runs_to_the_horizon() -> None:
    plan = plan_of(PICK)
    config = config_of(limits={"pick": SubtaskConfig(4, 20.0)}, continuous=True)
    progress = start(plan, config)
    progress, outcome = step(progress, plan, config, force=5.0)
    assert true_fields(outcome) == set()
    progress, outcome = step(progress, plan, config, force=5.0, success=True)
    assert true_fields(outcome) == {"success", "success_once", "success_at_end"}
    progress, outcome = step(progress, plan, config, force=5.0)
    assert true_fields(outcome) == {"success_once"}, "success may go away"
    assert progress.pointer[0] == 0 and progress.cumulative_force[0] == 15.0
    progress, outcome = step(progress, plan, config, force=50.0, force_ok=False)
    assert true_fields(outcome) == {
        "success_once",
        "force_exceeded",
        "fail",
        "timeout",
        "done",
        "ended",
    }
    assert progress.done[0] and progress.cumulative_force[0] == 65.0


def test_continuous_force_marks_the_failure_without_ending() -> None:
    plan = plan_of(PICK)
    progress, outcome = step(
        start(plan, CONTINUOUS), plan, CONTINUOUS, success=True, force_ok=False
    )
    assert true_fields(outcome) == {"force_exceeded", "fail"}
    assert not progress.done[0] and not progress.success_once[0]


@pytest.mark.parametrize(
    ("at_end", "once", "fail"),
    [(True, True, False), (False, True, False), (False, False, True)],
)
def test_continuous_success_once_and_at_end(at_end: bool, once: bool, fail: bool) -> None:
    plan = plan_of(CLOSE)
    config = config_of(limits={"close": SubtaskConfig(2, 1e9)}, continuous=True)
    progress, _ = step(start(plan, config), plan, config, success=once)
    _, outcome = step(progress, plan, config, success=at_end)
    assert outcome.done[0] and outcome.ended[0]
    assert (outcome.success_at_end[0], outcome.success_once[0], outcome.fail[0]) == (
        at_end,
        once,
        fail,
    )


@pytest.mark.parametrize("outcome_in_step", [{"success": True}, {"force_ok": False}])
def test_an_episode_ends_some_steps_after_its_outcome(
    outcome_in_step: dict[str, bool],
) -> None:
    plan = plan_of(PICK)
    config = replace(CONTINUOUS, hold_steps=2)
    progress, outcome = step(start(plan, config), plan, config)
    assert progress.steps_left[0] == limits_of(config, "pick").horizon - 1
    later = {name: value for name, value in outcome_in_step.items() if name == "force_ok"}
    progress, outcome = step(progress, plan, config, **outcome_in_step)
    ends = []
    for held in (outcome_in_step, later):
        assert not outcome.done[0]
        progress, outcome = step(progress, plan, config, **held)
        ends.append(bool(outcome.ended[0]))
    assert ends == [False, True], "a success that lasts does not begin anew"
    assert outcome.success_once[0] == outcome_in_step.get("success", False)


def test_the_horizon_ends_an_episode_before_what_is_held() -> None:
    plan = plan_of(PICK)
    config = replace(CONTINUOUS, hold_steps=50, limits={"pick": SubtaskConfig(2, 20.0)})
    progress, _ = step(start(plan, config), plan, config, success=True)
    _, outcome = step(progress, plan, config, success=True)
    assert outcome.done[0] and outcome.success_at_end[0]


@pytest.mark.parametrize(
    "config", [CONFIG, CONTINUOUS, replace(CONTINUOUS, hold_steps=1)]
)
def test_torch_advances_the_same_in_value_and_dtype(config: TaskConfig) -> None:
    rng = np.random.default_rng(3)
    worlds = 300
    plan = map_record(lambda x: np.repeat(x, worlds, axis=0), PLAN)
    progress = start(plan, config)
    other = to_torch(progress)
    torch_plan = to_torch(plan)
    assert_same_record(progress, start(torch_plan, config))
    progress = replace(progress, steps_left=rng.integers(1, 8, worlds))
    other = to_torch(progress)
    for _ in range(6):
        holds = {
            name: rng.random(worlds) < p
            for name, p in (("success", 0.4), ("force_ok", 0.9), ("placed_ok", 0.9))
        }
        force = rng.random(worlds)
        here = signals(worlds, **holds)
        progress, outcome = advance(
            accumulate(progress, force, 2 * force), here, plan, config
        )
        other, torch_outcome = advance(
            accumulate(other, to_force(force), 2 * to_force(force)),
            to_torch(here),
            torch_plan,
            config,
        )
        assert_same_record(progress, other)
        assert_same_record(outcome, torch_outcome)
        assert (
            not (outcome.done & ~outcome.ended).any()
            and not (outcome.advanced & outcome.fail).any()
        )
    mask = rng.random(worlds) < 0.5
    assert_same_record(
        reset_rows(progress, mask, plan, config),
        reset_rows(other, to_mask(mask), torch_plan, config),
    )


def to_force(force: np.ndarray) -> Any:
    return to_torch(signals(len(force), robot_force=force)).robot_force


def to_mask(mask: np.ndarray) -> Any:
    return to_torch(signals(len(mask), contact=mask)).contact


def test_progressive_completion_and_its_bound() -> None:
    np.testing.assert_allclose(progressive([0, 1, 3, 3], 4), [0.75, 0.5, 0.5, 0.0])
    np.testing.assert_allclose(upper_bound([0.5, 1.0, 0.5]), [0.5, 0.5, 0.25])
    assert np.isnan(progressive([], 2)).all()
    with refused("completed counts", (3, 3), expected="in 0..2"):
        progressive([3], 2)
