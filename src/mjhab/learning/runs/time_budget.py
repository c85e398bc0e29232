"""The time budget of a run: what the evaluations to come need of it, and whether it covers the first update."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from mjhab.learning.runs import distributed
from mjhab.learning.runs.budget import BudgetTooSmallError, FirstUpdate, Rates
from mjhab.learning.runs.evaluation import EvaluationClock


@dataclass(frozen=True)
class _Expected:
    """Work that the first update waits for. since: time of the run when it began [s]."""

    needs: FirstUpdate
    rates: Rates
    since: float


class TimeBudget:
    """Watches the time of a run. Several processes decide as the first one does, since they wait for each other.

    Args:
        seconds: the budget [s]; 0 for none.
        now: time of the run [s].
        to_judge: number of episodes of every scene whose evaluation is still to come.
        scenes: their number.
    """

    def __init__(
        self,
        seconds: float,
        now: Callable[[], float],
        to_judge: Callable[[], int],
        scenes: int,
    ) -> None:
        self._seconds = seconds
        self._now = now
        self._to_judge = to_judge
        self._scenes = scenes
        self._expected: _Expected | None = None
        self.evaluations = EvaluationClock(seconds)

    @property
    def seconds_left(self) -> float:
        """Time that is left for training [s]; meaningless without a budget."""
        return self._seconds - self._now() - self.evaluations.reserve(self._to_judge())

    def is_spent(self) -> bool:
        """Whether the rest of the budget is needed for the evaluations to come."""
        # Clocks differ: a process that stopped alone would leave the others waiting.
        return bool(self._seconds) and distributed.decided_by_first(
            self.seconds_left < 0.0
        )

    def estimate_evaluation(self, seconds: float) -> None:
        """Take the time that an episode of the expert needs [s] for that of an evaluation, until one is measured."""
        # The episodes of every scene are evaluated, so the scenes' times add up.
        self.evaluations.guess(self._scenes * seconds)

    def expect_nothing(self) -> None:
        """The first update was made."""
        self._expected = None

    def expect(self, needs: FirstUpdate, kind: Mapping[str, Any]) -> bool:
        """The first update waits for some work: refuse the budget if it ends before, as far as earlier runs tell.

        Args:
            needs: the work.
            kind: JSON data that determines the time of a piece of it.

        Returns:
            Whether nothing need be measured beforehand: the time of a piece is known, or there is no budget.

        Raises:
            BudgetTooSmallError: it tells what is needed.
        """
        if not self._seconds:
            return True
        self._expected = _Expected(needs, Rates(kind), self._now())
        known = self._expected.rates.seconds
        self.check(known)
        return known is not None

    def measured(self, seconds: float) -> None:
        """Check the budget again with a measured time of a piece of the expected work [s], and keep it for other runs.

        Raises:
            BudgetTooSmallError: it tells what is needed.
        """
        if self._expected is not None:
            # One file for all processes of the machine.
            if not distributed.rank():
                self._expected.rates.learn(seconds)
            self.check(seconds)

    def check(self, seconds: float | None) -> None:
        """Check the budget with the time of a piece of the expected work [s], None while it is not known.

        Raises:
            BudgetTooSmallError: it tells what is needed.
        """
        expected = self._expected
        assert expected is not None
        short = ""
        if seconds is not None:
            if expected.needs.of_expert:
                self.estimate_evaluation(seconds)
            episodes = self._to_judge()
            try:
                expected.needs.check(
                    self._seconds,
                    seconds,
                    expected.since,
                    self._scenes * episodes,
                    self.evaluations.needed(episodes),
                    self.evaluations.reserve(episodes),
                )
            # Raised below, when all processes have agreed.
            except BudgetTooSmallError as error:
                short = str(error)
        if distributed.decided_by_first(bool(short)):
            raise BudgetTooSmallError(short)
