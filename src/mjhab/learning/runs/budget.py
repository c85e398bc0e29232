"""Whether the time budget of a run covers its first update, told before the work towards it begins.

What the first update waits for is a number of equal pieces: episodes of the expert, or control steps of all worlds. The
time of a piece is known from an earlier run on this machine, from a probe of one wave of episodes, or from the first
control steps. Once the work runs it is measured again, and more accurately.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjhab.core.errors import UsageError
from mjhab.core.files.cache import cache_dir, write_text
from mjhab.core.files.reading import read_json_object
from mjhab.core.machine import cores, processor
from mjhab.core.version import __version__
from mjhab.learning.runs.specs import SECONDS_PER_MINUTE
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import Policy, RolloutEnv
from mjhab.rollout.sinks import Sink, StepView

MEASURED_WAVES = 2
"""Waves of episodes whose time is measured, after a first one that fills caches. A wave is one episode per world."""
PROBED_STEPS = 10
"""Control steps whose time is measured, after a first one that compiles and plans."""
_RATES = "rates.json"
_MOST_RATES = 200
"""Entries of the file of rates: the oldest ones go."""


class EpisodeClock:
    """Measures the time of an episode while a round is collected.

    Args:
        at_once: number of episodes that run at the same time.
    """

    def __init__(self, at_once: int) -> None:
        self._at_once = at_once
        self._first: int | None = None
        self._mark: tuple[int, float] | None = None

    def seconds(self, tried: int, now: float) -> float | None:
        """Wall time per episode [s], or None while it is not known.

        Args:
            tried: number of episodes so far, those of an earlier start of the run included.
            now: time of the run [s].
        """
        if self._first is None:
            self._first = tried
        # Times of the first wave would include reading meshes and compiling.
        if self._mark is None:
            if tried - self._first >= self._at_once:
                self._mark = (tried, now)
            return None
        before, then = self._mark
        if tried - before < MEASURED_WAVES * self._at_once:
            return None
        return (now - then) / (tried - before)


class StepClock:
    """Measures the time of a control step from the first ones of a run."""

    def __init__(self) -> None:
        self._steps = 0
        self._mark = 0.0

    def seconds(self, now: float) -> float | None:
        """Wall time per control step [s], once, when PROBED_STEPS were measured; else None.

        Args:
            now: time of the run after another control step [s].
        """
        self._steps += 1
        if self._steps == 1:
            self._mark = now
        if self._steps != 1 + PROBED_STEPS:
            return None
        return (now - self._mark) / PROBED_STEPS


class BudgetTooSmallError(Exception):
    """The time budget of a run ends before its first update; the message tells what the run needs."""


@dataclass(frozen=True)
class FirstUpdate:
    """What a run needs before its first update, and after its last one.

    work: what the first update waits for, e.g. "200 episodes of the expert". pieces: their number. less: options of
    which a new run would need less. of_expert: pieces are episodes of the expert, which last about as long as evaluated
    ones.
    """

    work: str
    pieces: float
    less: str
    of_expert: bool = False

    def check(
        self,
        budget: float,
        seconds: float,
        spent: float,
        evaluated: int,
        judging: float,
        reserved: float,
    ) -> None:
        """Refuse a budget [s] in which no update would be made; 0 is without limit.

        Args:
            budget: of the run [s].
            seconds: of a piece [s].
            spent: time of the run when the work began [s].
            evaluated: number of episodes of the evaluations that the budget must cover.
            judging: time of these as far as it is known [s].
            reserved: time that is kept free for them [s].

        Raises:
            BudgetTooSmallError: it tells what the run needs.
        """
        work = seconds * self.pieces
        if not budget or spent + work + reserved <= budget:
            return
        needed = spent + work + judging
        # One more for the updates, of which nothing is known yet.
        least = math.ceil(needed / SECONDS_PER_MINUTE) + 1
        raise BudgetTooSmallError(
            f"a budget of {_minutes(budget)} ends before the first update: {self.work} take {_minutes(work)} here "
            f"({seconds:.2g} s each), {evaluated} episodes of evaluation {_minutes(judging)}, and the updates "
            f"come on top. Give --budget-minutes {least} or more (with --resume, what was collected is kept), or "
            f"fewer {self.less} in a new run."
        )


def _minutes(seconds: float) -> str:
    return f"{seconds / SECONDS_PER_MINUTE:.1f} minutes"


class Rates:
    """How long pieces of work take on this machine, as earlier runs measured it: a file in the cache.

    Args:
        work: JSON data that determines the time of a piece, besides machine and version.
    """

    def __init__(self, work: Mapping[str, Any]) -> None:
        # All that a rate depends on; a new version may be faster.
        parts = [dict(work), processor(), cores(), __version__]
        text = json.dumps(parts, sort_keys=True, default=str)
        self._key = hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def seconds(self) -> float | None:
        """The shortest time that was measured of a piece [s]: the machine may have been busy; None without any."""
        found = self._read().get(self._key)
        return float(found) if isinstance(found, int | float) else None

    def learn(self, seconds: float) -> None:
        """Keep a measured time of a piece [s]."""
        kept = self._read()
        # Taken out and put back, so that it becomes the newest.
        known = kept.pop(self._key, math.inf)
        # A slower one may have been measured while the machine was busy.
        kept[self._key] = min(seconds, known)
        newest = dict(list(kept.items())[-_MOST_RATES:])
        text = json.dumps(newest, indent=1) + "\n"
        # A rate that cannot be kept is measured again.
        with contextlib.suppress(OSError):
            write_text(_file(), text)

    def _read(self) -> dict[str, Any]:
        try:
            return dict(read_json_object(_file()))
        # A damaged cache is an empty one.
        except UsageError:
            return {}


def _file() -> Path:
    return cache_dir() / _RATES


class _Decided(Exception):
    """A probe knows enough."""


class _Probe(Sink[RolloutEnv]):
    """Ends a rollout early if even episodes that last to the horizon fit.

    Args:
        clock: the time [s].
        enough: longest time of a wave that certainly fits [s].
        horizon: control steps of an episode at most.
    """

    def __init__(self, clock: Callable[[], float], enough: float, horizon: int) -> None:
        self._clock = clock
        self._enough = enough
        self._horizon = horizon
        self._steps = StepClock()
        self.began = 0.0

    def on_step(self, env: RolloutEnv, step: StepView) -> None:
        """Note the time of a control step."""
        now = self._clock()
        self.began = self.began or now
        seconds = self._steps.seconds(now)
        if seconds is not None and seconds * self._horizon <= self._enough:
            raise _Decided


def wave_seconds(
    env: RolloutEnv,
    policy: Policy,
    seed: int,
    enough: float,
    horizon: int,
    clock: Callable[[], float] = time.perf_counter,
) -> float | None:
    """Wall time of one episode in every world [s], apart from the reset; the episodes are not kept.

    Args:
        env: the environment.
        policy: acts in it.
        seed: of the episodes 0 to W-1.
        enough: time [s]; None is returned as soon as a wave of whole horizons is known to take no longer.
        horizon: control steps of an episode at most.
        clock: the time [s].
    """
    probe = _Probe(clock, enough, horizon)
    try:
        rollout(env, policy, range(env.num_envs), seed, [probe])
    except _Decided:
        return None
    return clock() - probe.began
