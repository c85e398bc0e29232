"""A budget that covers no update is refused before the work begins, by earlier rates, a probe or the first steps."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjhab.data.record.generation import Standing
from mjhab.learning.runs import budget, imitation, train
from mjhab.learning.runs.budget import EpisodeClock, Rates, StepClock, wave_seconds
from mjhab.learning.runs.imitation import ImitationSession
from mjhab.learning.runs.run import Logbook
from tests.learning.small import layout, train_config, train_in
from tests.learning.test_training import request, source
from tests.rollout.fake_env import FakeEnv

__all__ = ["source"]


class Clock:
    """A time that only the test lets pass."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Clock:
    """The time of runs, whose rates are kept in a file of the test."""
    made = Clock()
    monkeypatch.setattr(Logbook, "seconds", property(lambda _: made.now))
    monkeypatch.setattr(budget, "_file", lambda: tmp_path / "rates.json")
    return made


def test_an_episode_is_timed_after_the_first_wave() -> None:
    clock = EpisodeClock(at_once=4)
    # 7 episodes are of an earlier start; the first wave fills caches.
    told = [(7, 0.0), (10, 50.0), (11, 60.0), (15, 62.0), (18, 63.5), (19, 64.0)]
    assert [clock.seconds(*each) for each in told] == [None] * 5 + [0.5]


def test_a_control_step_is_timed_after_the_first_one() -> None:
    steps = StepClock()
    told = [steps.seconds(100.0 + 2.0 * number) for number in range(13)]
    assert told == [None] * 10 + [2.0] + [None] * 2


def test_rates_of_a_machine_are_the_shortest_measured(clock: Clock) -> None:
    rates = Rates({"scene": "a"})
    assert rates.seconds is None
    for seconds in (3.0, 2.0, 4.0):
        rates.learn(seconds)
    assert Rates({"scene": "a"}).seconds == 2.0
    assert Rates({"scene": "b"}).seconds is None
    for number in range(budget._MOST_RATES):
        Rates({"scene": number}).learn(1.0)
    assert rates.seconds is None
    budget._file().write_text("no JSON", encoding="utf-8")
    assert rates.seconds is None
    rates.learn(5.0)
    assert rates.seconds == 5.0


def test_a_wave_is_timed_unless_it_fits_in_any_case() -> None:
    """Every control step takes a second, and the first one plans."""
    clock = Clock()

    class Slow:
        name = "slow"

        def reset(self, mask: np.ndarray) -> None:
            pass

        def act(self, obs: Any, info: Any) -> np.ndarray:
            clock.now += 1.0
            return np.zeros((2, 13), np.float32)

    env = FakeEnv(num_envs=2)
    assert wave_seconds(env, Slow(), 0, 99.0, 100, clock) == env.steps_taken - 1 > 11
    assert env.resets == [[0, 1]]
    clock.now = 0.0
    assert wave_seconds(env, Slow(), 0, 100.0, 100, clock) is None
    assert clock.now == 11.0


@pytest.fixture
def expert(
    clock: Clock, monkeypatch: pytest.MonkeyPatch, source: Path
) -> dict[str, list[Any]]:
    """The expert needs 2 s for an episode; what was probed and tried."""
    seen: dict[str, list[Any]] = {"probed": [], "tried": []}
    monkeypatch.setattr(train, "layout_for", lambda _: layout())

    def collect(collector: Any, wanted: Any, out: Path, tell: Any, stopped: Any) -> Any:
        for number in range(1, wanted.episodes + 1):
            clock.now += 2.0
            seen["tried"].append(number)
            standing = Standing(number, number, number, number, 0, Counter())
            tell(standing)
            if stopped():
                return standing
        return dataclasses.replace(standing, complete=True)

    def probe(collector: Any, wanted: Any, enough: float, time: Any) -> float | None:
        seen["probed"].append(enough)
        wave = 4 * 2.0
        return None if enough >= 100.0 else wave

    monkeypatch.setattr(imitation.Collector, "collect", collect)
    monkeypatch.setattr(imitation.Collector, "wave_seconds", probe)
    monkeypatch.setattr(
        ImitationSession, "load_round", lambda session, _: session.load(source)
    )
    monkeypatch.setattr(ImitationSession, "evaluate", lambda *_, **__: 0.0)
    return seen


def asked(source: Path, minutes: float) -> Any:
    """100 episodes of the expert in 4 worlds, and 20 of evaluation."""
    return request(
        source,
        data=(),
        where=None,
        preset=train_config(demos=100),
        worlds=4,
        eval_episodes=20,
        round_episodes=0,
        budget_minutes=minutes,
    )


@pytest.mark.parametrize("seconds", [60.0, 220.0])
def test_a_budget_that_covers_no_update_is_refused_before_the_round(
    seconds: float, source: Path, tmp_path: Path, clock: Clock, expert: dict[str, Any]
) -> None:
    """100 episodes of 2 s do not fit into 60 s, nor with 20 of evaluation into 220 s."""
    early = train_in(asked(source, seconds / 60.0), tmp_path / "small").summary
    assert "100 episodes of the expert take 3.3 minutes" in early["shortage"]
    assert "--budget-minutes 5 or more" in early["shortage"]
    assert not early["trained"] and early["checkpoint"] is None
    assert expert["tried"] == [] and len(expert["probed"]) == 1
    done = train_in(asked(source, 6.0), tmp_path / "small", resume=True).summary
    assert done["trained"] and "shortage" not in done


def test_a_second_run_knows_the_rate_of_the_first_one(
    source: Path, tmp_path: Path, clock: Clock, expert: dict[str, Any]
) -> None:
    assert train_in(asked(source, 6.0), tmp_path / "first").summary["trained"]
    clock.now = 0.0
    expert["probed"].clear()
    expert["tried"].clear()
    early = train_in(asked(source, 3.0), tmp_path / "second").summary
    assert "(2 s each)" in early["shortage"]
    assert expert == {"probed": [], "tried": []}


def test_what_a_probe_did_not_see_is_told_while_the_round_is_young(
    source: Path,
    tmp_path: Path,
    clock: Clock,
    expert: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(imitation.Collector, "wave_seconds", lambda *_: None)
    early = train_in(asked(source, 1.0), tmp_path / "run").summary
    assert "--budget-minutes 5 or more" in early["shortage"]
    # A first wave, counted from the first standing, and two that are measured.
    assert len(expert["tried"]) == 1 + 3 * 4
