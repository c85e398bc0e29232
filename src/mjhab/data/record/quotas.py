"""Which finished episodes are kept: a rule that speaks of their indices alone, however many workers finish them when.

An episode is kept if it passes the filter and fewer than the quota of episodes with lower indices were kept for its
target (and label). So the set is what one worker would keep that takes the indices in order. An episode is decided as
soon as no lower index that is still open can change the answer; far from the quota that is at once.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

from mjhab.core.errors import UsageError

_NONE = 1 << 62


@dataclass(frozen=True)
class Outcome:
    """What counts of a finished episode; ``target`` is what quotas are counted by."""

    index: int
    target: str
    label: str
    passes: bool


@dataclass(frozen=True)
class Surety:
    """For which targets an episode that passes will be kept for certain, so that it can be written at once."""

    default: bool
    others: frozenset[str] = frozenset()
    """Targets for which it is the other way round."""

    def __call__(self, target: str) -> bool:
        """Whether it is certain for ``target``."""
        return self.default != (target in self.others)


class Quotas:
    """Keeps count. Indices are open until they are reported.

    Args:
        targets: those that must be full before all is done; others may turn up and have quotas too.
        per_target: episodes to keep of every target; 0 for no limit.
        per_label: episodes to keep of every label of every target; 0 for no limit.

    Raises:
        UsageError: a negative quota.
    """

    def __init__(
        self, targets: Iterable[str] = (), per_target: int = 0, per_label: int = 0
    ) -> None:
        if per_target < 0 or per_label < 0:
            raise UsageError(
                f"quotas are at least 0 (no limit); got {per_target} per target, {per_label} per label."
            )
        self.targets = tuple(targets)
        self._per_target = per_target or _NONE
        self._per_label = per_label or _NONE
        self._kept: dict[tuple[str, str | None], list[int]] = defaultdict(list)
        self._waiting: dict[int, Outcome] = {}
        self._frontier = 0
        self._beyond = set[int]()
        self.outcomes: dict[int, Outcome] = {}
        """Of all reported episodes, by index."""

    @property
    def labels(self) -> Counter[str]:
        """Labels of the kept episodes."""
        counted = Counter({key: len(kept) for key, kept in self._kept.items()})
        return Counter(
            {
                label: sum(n for (_, other), n in counted.items() if other == label)
                for label in sorted({label for _, label in counted if label is not None})
            }
        )

    @property
    def kept(self) -> int:
        """Number of episodes that are kept."""
        return sum(len(kept) for (_, label), kept in self._kept.items() if label is None)

    def count(self, target: str) -> int:
        """Number of episodes kept of a target."""
        return len(self._kept[target, None])

    @property
    def full(self) -> bool:
        """Whether every target has its quota: nothing that is still open can be kept."""
        return bool(self.targets) and all(
            self.count(target) >= self._per_target for target in self.targets
        )

    def is_open(self, index: int) -> bool:
        """Whether an index was not reported yet."""
        return index >= self._frontier and index not in self._beyond

    def report(self, outcome: Outcome, kept: bool | None = None) -> None:
        """Take in a finished episode; an index that was reported before changes nothing.

        ``kept``: what was decided about it in an earlier run; None leaves that to the rule.
        """
        if not self.is_open(outcome.index):
            return
        self.outcomes[outcome.index] = outcome
        self._beyond.add(outcome.index)
        while self._frontier in self._beyond:
            self._beyond.remove(self._frontier)
            self._frontier += 1
        if kept:
            self._keep(outcome)
        elif kept is None and outcome.passes:
            self._waiting[outcome.index] = outcome

    def forget(self, index: int) -> bool:
        """Open an index again whose data were lost before it was decided; returns whether it was undecided."""
        if self._waiting.pop(index, None) is None:
            return False
        del self.outcomes[index]
        self._beyond.discard(index)
        if index < self._frontier:
            self._beyond.update(range(index + 1, self._frontier))
            self._frontier = index
        return True

    def would_drop(self, outcome: Outcome) -> bool:
        """Whether lower indices that are kept already have filled its quota."""
        low, label_low = (bisect_left(self._kept[key], outcome.index) for key in _keys(outcome))
        return low >= self._per_target or label_low >= self._per_label

    def decide(self) -> dict[int, bool]:
        """Decide what can be decided; returns whether to keep, by index, of those that could now be."""
        decided: dict[int, bool] = {}
        for index in sorted(self._waiting):
            outcome = self._waiting[index]
            if self.would_drop(outcome):
                decided[index] = False
            elif self._is_certain(outcome):
                decided[index] = True
                self._keep(outcome)
            else:
                continue
            del self._waiting[index]
        return decided

    def surety(self, last: int) -> Surety:
        """For which targets every open episode up to index ``last`` will be kept if it passes."""
        unknown = self._open_below(last + 1)
        default = unknown <= min(self._per_target, self._per_label)
        waiting = Counter(key for outcome in self._waiting.values() for key in _keys(outcome))
        sizes = {
            key: len(self._kept[key]) + waiting[key] + unknown for key in {*self._kept, *waiting}
        }
        others: set[str] = set()
        for target in {target for target, _ in sizes}:
            labels = [
                n for (other, label), n in sizes.items() if other == target and label is not None
            ]
            certain = sizes.get((target, None), unknown) <= self._per_target
            if (certain and max(labels, default=unknown) <= self._per_label) != default:
                others.add(target)
        return Surety(default, frozenset(others))

    def _keep(self, outcome: Outcome) -> None:
        for key in _keys(outcome):
            insort(self._kept[key], outcome.index)

    def _open_below(self, index: int) -> int:
        below = sum(reported < index for reported in self._beyond)
        return max(0, index - self._frontier - below)

    def _is_certain(self, outcome: Outcome) -> bool:
        index = outcome.index
        unknown = self._open_below(outcome.index)
        for key, quota in zip(_keys(outcome), (self._per_target, self._per_label), strict=True):
            waiting = sum(
                other.index < index and key in _keys(other) for other in self._waiting.values()
            )
            if bisect_left(self._kept[key], index) + waiting + unknown >= quota:
                return False
        return True


def _keys(outcome: Outcome) -> tuple[tuple[str, str | None], tuple[str, str | None]]:
    return (outcome.target, None), (outcome.target, outcome.label)
