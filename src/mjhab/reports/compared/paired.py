"""Two policies, or one under two conditions, in the same episodes: what differs, and how sure that is."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mjhab.reports.metrics import wilson
from mjhab.rollout.records import EpisodeRecord

NOT_REACHED = "not_reached"
"""In place of the label of a subtask that an episode did not end."""
UNLABELLED = "no_label"
"""In place of the label of a subtask whose kind has none."""


@dataclass(frozen=True)
class Paired:
    """Outcomes of the episodes that two runs A and B have in common, named by (seed, index).

    Attributes:
        both: number of episodes that both do. neither: that none does.
        only_a: indices of the episodes that A does and B does not. only_b: the other way round.
        labels: subtasks that ended with other labels: (label in A, label in B, their number), most frequent first.
    """

    both: int
    neither: int
    only_a: tuple[int, ...]
    only_b: tuple[int, ...]
    labels: tuple[tuple[str, str, int], ...]

    @property
    def episodes(self) -> int:
        """Number of episodes in common."""
        return self.both + self.neither + len(self.only_a) + len(self.only_b)

    @property
    def difference(self) -> float:
        """Success of B minus that of A, in -1..1, to 4 digits; 0 without episodes."""
        more = len(self.only_b) - len(self.only_a)
        return round(more / self.episodes, 4) if self.episodes else 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of `difference`, see `paired_interval`."""
        return paired_interval(
            self.both, len(self.only_a), len(self.only_b), self.neither
        )

    @property
    def p(self) -> float:
        """McNemar's exact p, see `mcnemar`."""
        return mcnemar(len(self.only_a), len(self.only_b))

    def as_json(self) -> dict[str, Any]:
        """All of it as plain data."""
        low, high = self.interval
        return {
            "episodes": self.episodes,
            "both": self.both,
            "neither": self.neither,
            "only_a": list(self.only_a),
            "only_b": list(self.only_b),
            "difference": self.difference,
            "low": low,
            "high": high,
            "p": self.p,
            "labels": [
                {"a": before, "b": after, "subtasks": count}
                for before, after, count in self.labels
            ],
        }


def paired(first: Sequence[EpisodeRecord], second: Sequence[EpisodeRecord]) -> Paired:
    """Pair the episodes of run A (``first``) and run B (``second``) by (seed, index); others are left out."""
    others = {(record.seed, record.index): record for record in second}
    pairs = [
        (record, others[record.seed, record.index])
        # Episodes of several workers come in the order in which they finish.
        for record in sorted(first, key=lambda record: (record.seed, record.index))
        if (record.seed, record.index) in others
    ]
    outcomes = [(a.success_once, b.success_once, a.index) for a, b in pairs]
    changes = Counter(change for a, b in pairs for change in _label_changes(a, b))
    return Paired(
        both=len([1 for a, b, _ in outcomes if a and b]),
        neither=sum(not (a or b) for a, b, _ in outcomes),
        only_a=tuple(index for a, b, index in outcomes if a and not b),
        only_b=tuple(index for a, b, index in outcomes if b and not a),
        labels=_by_count(changes),
    )


def together(parts: Sequence[Paired]) -> Paired:
    """Pairs of several groups of episodes as one; indices are those within the groups."""
    labels: Counter[tuple[str, str]] = Counter()
    for part in parts:
        for before, after, count in part.labels:
            labels[before, after] += count
    return Paired(
        both=sum(part.both for part in parts),
        neither=sum(part.neither for part in parts),
        only_a=tuple(index for part in parts for index in part.only_a),
        only_b=tuple(index for part in parts for index in part.only_b),
        labels=_by_count(labels),
    )


def _by_count(changes: Counter[tuple[str, str]]) -> tuple[tuple[str, str, int], ...]:
    """Changes of labels and their numbers, the most frequent first."""
    # By name among equals, so that the same runs give the same page.
    ordered = sorted(changes.items(), key=lambda item: (-item[1], item[0]))
    return tuple((before, after, count) for (before, after), count in ordered)


def _label_changes(a: EpisodeRecord, b: EpisodeRecord) -> list[tuple[str, str]]:
    """Labels in A and B of the subtasks that have others there."""
    labels = [
        {entry.index: entry.label or UNLABELLED for entry in record.subtasks}
        for record in (a, b)
    ]
    found = [
        tuple(each.get(k, NOT_REACHED) for each in labels) for k in range(len(a.plan))
    ]
    return [(before, after) for before, after in found if before != after]


def mcnemar(only_a: int, only_b: int) -> float:
    """Exact two-sided p of McNemar's test, to 4 significant digits: 1 where A and B differ in no episode.

    The chance that ``only_a + only_b`` fair coins fall at least as unevenly as the episodes that one alone does.
    """
    if not only_a + only_b:
        return 1.0
    from scipy.stats import binomtest  # half a second

    return float(f"{binomtest(only_a, only_a + only_b).pvalue:.4g}")


def paired_interval(
    both: int, only_a: int, only_b: int, neither: int
) -> tuple[float, float]:
    """95 % interval of the difference (B minus A) of two rates over the same episodes, to 4 digits.

    Newcombe's square-and-add interval of paired proportions (Statistics in Medicine 17 (1998) 2635, method 10), made
    of the Wilson intervals of both rates; (-1, 1) without episodes.
    """
    total = both + only_a + only_b + neither
    if not total:
        return (-1.0, 1.0)
    won_a = both + only_a
    won_b = both + only_b
    rate_a, rate_b = won_a / total, won_b / total
    (low_a, high_a), (low_b, high_b) = wilson(won_a, total), wilson(won_b, total)
    alike = _correlation(both, only_a, only_b, neither)

    def reach(up: float, down: float) -> float:
        # Rounding can make the square slightly negative where both parts are equal.
        return math.sqrt(max(up**2 - 2.0 * alike * up * down + down**2, 0.0))

    middle = rate_b - rate_a
    low = middle - reach(rate_b - low_b, high_a - rate_a)
    high = middle + reach(high_b - rate_b, rate_a - low_a)
    return (round(max(low, -1.0), 4), round(min(high, 1.0), 4))


def _correlation(both: int, only_a: int, only_b: int, neither: int) -> float:
    """Correlation of the outcomes with Newcombe's correction for continuity; 0 where one rate is 0 or 1."""
    size = (both + only_a) * (only_b + neither) * (both + only_b) * (only_a + neither)
    if not size:
        return 0.0
    total = both + only_a + only_b + neither
    product = both * neither - only_a * only_b
    if product > 0:
        # The correction must not turn the sign of a small correlation.
        product = max(product - total / 2.0, 0.0)
    return product / math.sqrt(size)
