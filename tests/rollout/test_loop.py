"""The rollout loop: records depend on (seed, index) only, idle worlds are left alone, sinks hear everything once."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy, ZeroPolicy
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView
from tests.refusals import refused
from tests.rollout.fake_env import FakeEnv


class Log(Sink):
    def __init__(self) -> None:
        self.announced: list[list[int]] = []
        self.begun: list[int] = []
        self.ended: list[int] = []
        self.steps: dict[int, int] = {}
        self.closed = 0

    def on_begin(self, env: Any, episodes: Sequence[int]) -> None:
        assert not self.begun
        self.announced.append(list(episodes))

    def on_reset(self, env: Any, info: Mapping[str, Any], mask: np.ndarray) -> None:
        self.begun += [info["episode_spec"][w]["index"] for w in np.flatnonzero(mask)]

    def on_step(self, env: Any, step: StepView) -> None:
        for w in np.flatnonzero(step.active):
            index = step.info["episode_spec"][w]["index"]
            self.steps[index] = self.steps.get(index, 0) + 1
            assert self.steps[index] == step.steps[w]

    def on_episode_end(self, env: Any, world: int, record: EpisodeRecord) -> None:
        self.ended.append(record.index)

    def close(self) -> None:
        self.closed += 1


@pytest.mark.parametrize("policy", ["zero", "random"])
def test_records_do_not_depend_on_the_number_of_worlds(policy: str) -> None:
    def run(worlds: int) -> list[EpisodeRecord]:
        return rollout(
            FakeEnv(worlds),
            ZeroPolicy() if policy == "zero" else RandomPolicy(3),
            range(9),
            seed=3,
        )

    one = run(1)
    assert [record.index for record in one] == list(range(9))
    assert one == run(4) == run(8) == run(16)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 40), unique=True, max_size=12), st.integers(1, 6))
def test_any_order_gives_the_same_records(indices: list[int], worlds: int) -> None:
    shuffled = rollout(FakeEnv(worlds), RandomPolicy(1), indices, seed=1)
    assert shuffled == rollout(FakeEnv(2), RandomPolicy(1), sorted(indices), seed=1)
    assert [record.index for record in shuffled] == sorted(indices)


def test_seed_changes_the_episodes() -> None:
    assert rollout(FakeEnv(2), ZeroPolicy(), range(4), seed=0) != rollout(
        FakeEnv(2), ZeroPolicy(), range(4), seed=1
    )


def test_sinks_hear_every_step_of_every_episode_once() -> None:
    log = Log()
    env = FakeEnv(3)
    records = rollout(env, ZeroPolicy(), [7, 2, 5, 0, 9], seed=0, sinks=[log])
    assert env.resets[0] == [7, 2, 5], "worlds are filled in the order given"
    assert log.begun == [7, 2, 5, 0, 9] and sorted(log.ended) == [0, 2, 5, 7, 9]
    assert log.steps == {record.index: record.steps for record in records}
    assert log.closed == 1 and log.announced == [[7, 2, 5, 0, 9]]


def test_record_holds_what_happened() -> None:
    (record,) = rollout(
        FakeEnv(1, quality=1.0, taint_chance=1.0), RandomPolicy(0), [4], seed=5
    )
    assert (record.seed, record.index, record.home, record.task) == (
        5,
        4,
        "builtin_m0_00",
        "set_table",
    )
    assert record.success_once and record.success_at_end and not record.fail
    assert record.completed == len(record.plan) == len(record.subtasks) == 16
    assert record.steps == len(record.force) == record.subtasks[-1].end_step
    assert record.peak_force == pytest.approx(max(record.force), abs=0.05)
    assert record.peak_finger_force == pytest.approx(2 * record.peak_force, abs=0.01)
    assert record.peak_finger_force == max(
        subtask.peak_finger_force or 0.0 for subtask in record.subtasks
    )
    assert record.cumulative_force == pytest.approx(
        sum(record.force), abs=0.05 * record.steps
    )
    assert record.taint == ("contact_overflow", "deep_penetration")
    assert record.events[0] == (3, "contact") and record.events[-1] == (
        record.steps,
        "success",
    )
    assert list(record.events) == [
        event for subtask in record.subtasks for event in subtask.events
    ]


def test_failed_episode_lists_only_the_subtasks_it_reached() -> None:
    (record,) = rollout(FakeEnv(1, quality=0.0), ZeroPolicy(), [0], seed=0)
    assert len(record.subtasks) == 1 and record.subtasks[0].label == "navigation_failure"
    assert record.fail and record.completed == 0 and not record.success_once


def test_record_survives_json() -> None:
    for record in rollout(FakeEnv(2), RandomPolicy(0), range(4), seed=0):
        assert EpisodeRecord.from_dict(json.loads(json.dumps(record.to_dict()))) == record


def test_older_records_lack_finger_forces_and_tell_teleports_by_their_sentences() -> None:
    (record,) = rollout(FakeEnv(1, quality=1.0), ZeroPolicy(), [0], seed=0)
    told = json.loads(json.dumps(record.to_dict()))
    del told["peak_finger_force"]
    for subtask in told["subtasks"]:
        del subtask["peak_finger_force"]
    ways = [entry.kind == "navigate" for entry in record.plan]
    told["instructions"] = [
        "go on (by teleport)" if way else "do something" for way in ways
    ]
    old = EpisodeRecord.from_dict(told)
    assert old.peak_finger_force is None
    assert {subtask.peak_finger_force for subtask in old.subtasks} == {None}
    assert [subtask.teleported for subtask in old.subtasks] == ways
    assert "peak_finger_force" not in old.to_dict()
    assert EpisodeRecord.from_dict(old.to_dict()) == old
    quiet = dataclasses.replace(record, peak_finger_force=0.0)
    assert EpisodeRecord.from_dict(quiet.to_dict()) == quiet


@pytest.mark.parametrize(
    ("once", "events", "steps"),
    [
        (False, ((7, "contact"),), None),
        (True, ((7, "contact"), (12, "success"), (15, "lost_success")), 2),
        (True, ((12, "success"), (13, "lost_success"), (14, "success")), 2),
        (True, (), 1),
    ],
)
def test_steps_to_the_first_success_count_from_the_start_of_the_subtask(
    once: bool, events: tuple, steps: int | None
) -> None:
    (record,) = rollout(FakeEnv(1, quality=1.0), ZeroPolicy(), [0], seed=0)
    subtask = dataclasses.replace(
        record.subtasks[0], success_once=once, events=events, start_step=10, end_step=210
    )
    assert subtask.steps_to_success == steps
    whole = dataclasses.replace(record, subtasks=(subtask,), success_once=once, steps=210)
    assert whole.steps_to_success == (None if steps is None else 10 + steps)


def test_no_episodes_no_reset() -> None:
    env = FakeEnv(2)
    assert rollout(env, ZeroPolicy(), [], seed=0) == [] and env.resets == []


def test_max_steps_cuts_episodes() -> None:
    records = rollout(
        FakeEnv(2, quality=1.0), ZeroPolicy(), range(3), seed=0, max_steps=4
    )
    assert [record.steps for record in records] == [4, 4, 4]
    assert not any(record.success_once or record.fail for record in records)


def test_sinks_are_closed_when_interrupted() -> None:
    log = Log()
    env = FakeEnv(2)
    env.interrupt_at = 7
    with pytest.raises(KeyboardInterrupt):
        rollout(env, ZeroPolicy(), range(4), seed=0, sinks=[log])
    assert log.closed == 1


def test_an_interrupted_kernel_is_an_interrupt() -> None:
    class Stopped(ZeroPolicy):
        """Acts as a kernel of numba does that another calls while Ctrl-C comes."""

        reason: BaseException

        def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
            try:
                try:
                    raise self.reason
                except BaseException as error:
                    raise SystemError("inner") from error
            except SystemError as error:
                raise SystemError("outer") from error

    policy = Stopped()
    for policy.reason, seen in (
        (KeyboardInterrupt(), KeyboardInterrupt),
        (ValueError(), SystemError),
    ):
        log = Log()
        with pytest.raises(seen):
            rollout(FakeEnv(1), policy, range(1), seed=0, sinks=[log])
        assert log.closed == 1


@pytest.mark.parametrize("episodes", [[1, -2], [1, 1]])
def test_bad_indices_are_refused(episodes: list[int]) -> None:
    with refused("episode indices"):
        rollout(FakeEnv(1), ZeroPolicy(), episodes, seed=0)


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_an_env_that_resets_by_itself_is_refused(mode: AutoresetMode) -> None:
    env = FakeEnv(1)
    log = Log()
    env.metadata = {"autoreset_mode": mode}
    with refused("autoreset", advice="mjhab.evaluate"):
        rollout(env, ZeroPolicy(), [0], seed=0, sinks=[log])
    assert env.resets == [] and log.begun == []


def test_an_env_of_tensors_or_of_one_world_is_refused() -> None:
    env = FakeEnv(1)
    env.metadata["tensors"] = True
    with refused(said="backend='cpu'"):
        rollout(env, ZeroPolicy(), [0], seed=0)
    single: Any = SimpleNamespace(metadata={})
    with refused(said="needs a vector environment"):
        rollout(single, ZeroPolicy(), [0], seed=0)


@pytest.mark.parametrize("shape", [(13,), (1, 13), (13, 2), (2, 1, 13)])
def test_actions_must_have_a_row_per_world(shape: tuple[int, ...]) -> None:
    class Wrong(ZeroPolicy):
        def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
            return np.zeros(shape, np.float32)

    with refused(where="policy 'zero'", said="actions (W, A) for W = 2 worlds"):
        rollout(FakeEnv(2), Wrong(), range(2), seed=0)


def test_env_that_resets_to_another_episode_is_caught() -> None:
    class Wrong(FakeEnv):
        def reset(
            self, seed: int, options: dict[str, Any]
        ) -> tuple[np.ndarray, dict[str, Any]]:
            return super().reset(seed, {**options, "episode": options["episode"] + 1})

    with pytest.raises(RuntimeError, match="asked for episode 3"):
        rollout(Wrong(1), ZeroPolicy(), [3], seed=0)


class Careful(ZeroPolicy):
    """A policy that is asked to act in one way."""

    def style(self, world: int) -> Mapping[str, Any]:
        return {"speed": 0.5}


def test_the_style_of_a_policy_is_recorded() -> None:
    (record,) = rollout(FakeEnv(1), Careful(), [3], seed=0)
    assert (
        record.style == {"speed": 0.5}
        and EpisodeRecord.from_dict(record.to_dict()) == record
    )
    (plain,) = rollout(FakeEnv(1), ZeroPolicy(), [3], seed=0)
    assert (
        plain.style == {}
        and "style" not in plain.to_dict()
        and EpisodeRecord.from_dict(plain.to_dict()) == plain
    )


class Broken:
    """Stands still for some steps and returns something else then."""

    name = "broken"

    def __init__(self, worlds: int, given: Any, after: int = 3) -> None:
        self.good = np.zeros((worlds, 13), np.float32)
        self.given = given
        self.after = after

    def reset(self, mask: np.ndarray) -> None:
        pass

    def act(self, obs: Any, info: Mapping[str, Any]) -> Any:
        self.after -= 1
        return self.good if self.after >= 0 else self.given


def spoilt(value: float, world: int = 1) -> np.ndarray:
    actions = np.zeros((2, 13), np.float32)
    actions[world, 5] = value
    return actions


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            spoilt(np.nan),
            "returned nan in column 5 of its actions, in episode 1 after control step 3 (world 1)",
        ),
        (spoilt(-np.inf, 0), "returned -inf in column 5 of its actions, in episode 0"),
        (np.zeros(13), "actions (W, A) for W = 2 worlds, got (13,)"),
        (np.zeros((1, 13)), "got (1, 13)"),
        (np.zeros((2, 1, 13)), "got (2, 1, 13)"),
        (0.0, "got ()"),
        ("left", "got 'left' (str)"),
        (None, "got"),
        ([[1.0], [1.0, 2.0]], "must be numbers"),
    ],
    ids=repr,
)
def test_what_are_no_actions_is_told(given: Any, message: str) -> None:
    log = Log()
    with refused(where="policy 'broken'", said=message):
        rollout(FakeEnv(2), Broken(2, given), range(4), 0, [log])
    assert log.closed == 1


def test_idle_worlds_may_be_given_anything() -> None:
    rollout(FakeEnv(2), Broken(2, spoilt(np.nan)), [0], 0, max_steps=6)


def test_records_keep_sentences_and_refuse_what_is_none() -> None:
    data = rollout(FakeEnv(1), ZeroPolicy(), [0], 0)[0].to_dict()
    assert "instruction" not in data
    told = {**data, "instruction": "set the table", "instructions": ["go to the fridge"]}
    record = EpisodeRecord.from_dict(told)
    assert (record.instruction, record.instructions) == (
        "set the table",
        ("go to the fridge",),
    )
    for bad in ("two\nlines", "x" * 2000, 7):
        with pytest.raises(ValueError, match="an instruction or an error is"):
            EpisodeRecord.from_dict({**data, "instruction": bad})
