"""Whether the time budget of a run covers its first round, told while the round is young."""

from __future__ import annotations

import math
from dataclasses import dataclass

SECONDS_PER_MINUTE = 60.0
MEASURED_WAVES = 2
"""Waves of episodes whose time is measured, after a first one that fills caches. A wave is one episode per world."""


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
        if self._mark is None:
            if tried - self._first >= self._at_once:
                self._mark = (tried, now)
            return None
        before, then = self._mark
        if tried - before < MEASURED_WAVES * self._at_once:
            return None
        return (now - then) / (tried - before)


class BudgetTooSmallError(Exception):
    """The time budget of a run ends before its first update; the message tells what the run needs."""


@dataclass(frozen=True)
class RoundNeeds:
    """What a run needs before its first update, and after its last one.

    episodes: number to collect, of all scenes. seconds: of an episode [s]. spent: time of the run when the collection
    began [s]. evaluated: number of episodes of the evaluations that the budget must cover. reserved: time that is kept
    free for these [s].
    """

    episodes: int
    seconds: float
    spent: float
    evaluated: int
    reserved: float

    def check(self, budget: float) -> None:
        """Refuse a budget [s] in which no update would be made; 0 is without limit.

        Raises:
            BudgetTooSmallError: it tells what the run needs.
        """
        collection = self.seconds * self.episodes
        if not budget or self.spent + collection + self.reserved <= budget:
            return
        evaluation = self.seconds * self.evaluated
        needed = self.spent + collection + evaluation
        raise BudgetTooSmallError(
            f"a budget of {_minutes(budget)} ends before the first update: {self.episodes} episodes of the expert take "
            f"{_minutes(collection)} here ({self.seconds:.2g} s each), {self.evaluated} episodes of evaluation "
            f"{_minutes(evaluation)}, and the updates come on top. Give --budget-minutes "
            f"{math.ceil(needed / SECONDS_PER_MINUTE) + 1} or more (with --resume, what was collected is kept), or "
            "fewer --demos and --eval-episodes in a new run."
        )


def _minutes(seconds: float) -> str:
    return f"{seconds / SECONDS_PER_MINUTE:.1f} minutes"
