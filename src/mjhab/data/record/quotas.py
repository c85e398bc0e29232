"""The rule for keeping finished episodes. It does not depend on the number of workers or the order of finishing.

An episode is kept if it passes the filter and fewer episodes with lower indices than the quota allows are kept for its
target (and label). So the kept set is that of a single worker that takes the indices in order. An episode is decided as
soon as no open lower index can change the decision; far below the quota this is immediately.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from mjhab.core.errors import wrong_value

# An integer and not infinity: it is compared with and subtracted from counts.
_NONE = 1 << 62


@dataclass(frozen=True)
class Outcome:
    """The part of a finished episode that quotas count. passes: it passes the filter.

    ``skipped_homes``: homes without room in whose place its home was taken; they are counted for the summary alone.
    """

    index: int
    target: str
    label: str
    passes: bool
    skipped_homes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return JSON data; without skipped homes, if there are none."""
        fields = asdict(self)
        if not self.skipped_homes:
            del fields["skipped_homes"]
        return fields

    @classmethod
    def from_dict(cls, fields: Any) -> Outcome:
        """Read JSON data.

        Raises:
            ValueError: it is no outcome.
        """
        types = {"index": int, "target": str, "label": str, "passes": bool}
        given = {"skipped_homes": [], **fields} if isinstance(fields, dict) else {}
        skipped = given.pop("skipped_homes", None)
        # An exact match, since a line of another version would be counted wrongly.
        fits = given.keys() == types.keys() and isinstance(skipped, list)
        # `type` and not isinstance: JSON's true is an int to Python.
        if not fits or any(type(given[name]) is not kind for name, kind in types.items()):
            raise ValueError(f"no outcome of an episode: {str(fields)[:60]!r}")
        return cls(**given, skipped_homes=tuple(str(home) for home in skipped))


@dataclass(frozen=True)
class GuaranteedTargets:
    """Targets for which an episode that passes the filter is certainly kept, so that it can be written at once."""

    default: bool
    others: frozenset[str] = frozenset()
    """Targets to which the opposite of ``default`` applies."""

    def __call__(self, target: str) -> bool:
        """Whether episodes of ``target`` are certainly kept."""
        return self.default != (target in self.others)


class Quotas:
    """Counts kept episodes against quotas. An index is open until it is reported.

    Args:
        targets: targets whose quotas must be full at the end; other targets may occur and have the same quotas.
        per_target: number of episodes to keep per target; 0 for no limit.
        per_label: number of episodes to keep per target and label; 0 for no limit.

    Raises:
        UsageError: a negative quota.
    """

    def __init__(
        self, targets: Iterable[str] = (), per_target: int = 0, per_label: int = 0
    ) -> None:
        if per_target < 0 or per_label < 0:
            raise wrong_value(
                "quotas",
                (per_target, per_label),
                "at least 0 per target and per label (0: no limit)",
            )
        self.targets = tuple(targets)
        self._per_target = per_target or _NONE
        self._per_label = per_label or _NONE
        self._kept: dict[tuple[str, str | None], list[int]] = defaultdict(list)
        self._waiting: dict[int, Outcome] = {}
        # All indices below it are reported; the set beyond it stays as small as the disorder of the workers.
        self._frontier = 0
        self._beyond = set[int]()
        self.outcomes: dict[int, Outcome] = {}
        """Outcomes of all reported episodes by index."""

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
        """Whether the quota of every target is full, so that no open index can be kept."""
        # Before the first worker is ready no target is known, and nothing is full.
        return bool(self.targets) and all(
            self.count(target) >= self._per_target for target in self.targets
        )

    def is_open(self, index: int) -> bool:
        """Whether an index has not been reported yet."""
        return index >= self._frontier and index not in self._beyond

    def report(self, outcome: Outcome, kept: bool | None = None) -> None:
        """Count a finished episode; an index that was reported before is ignored.

        ``kept`` is the decision of an earlier run; None applies the rule.
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
        """Reopen an undecided index whose data were lost; returns whether it was undecided."""
        if self._waiting.pop(index, None) is None:
            return False
        # A lost index counts as never tried, since it will be simulated again.
        del self.outcomes[index]
        self._beyond.discard(index)
        if index < self._frontier:
            # The frontier moves back, and what lay between stays reported.
            self._beyond.update(range(index + 1, self._frontier))
            self._frontier = index
        return True

    def would_drop(self, outcome: Outcome) -> bool:
        """Whether kept episodes with lower indices already fill the quota."""
        low, label_low = (
            # Only lower indices count: this makes the choice independent of who finishes first.
            bisect_left(self._kept[key], outcome.index)
            for key in _keys(outcome)
        )
        return low >= self._per_target or label_low >= self._per_label

    def decide(self) -> dict[int, bool]:
        """Decide on all episodes that can be decided now; returns whether to keep them, by index."""
        decided: dict[int, bool] = {}
        # Ascending, because each decision may fill the quota for those after it.
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

    def guaranteed(self, last: int) -> GuaranteedTargets:
        """Targets for which every open episode up to index ``last`` is kept if it passes."""
        # Every open index below may still take a place of any target.
        unknown = self._open_below(last + 1)
        default = unknown <= min(self._per_target, self._per_label)
        waiting = Counter(
            key for outcome in self._waiting.values() for key in _keys(outcome)
        )
        sizes = {
            key: len(self._kept[key]) + waiting[key] + unknown
            for key in {*self._kept, *waiting}
        }
        others: set[str] = set()
        for target in {target for target, _ in sizes}:
            labels = [
                n
                for (other, label), n in sizes.items()
                if other == target and label is not None
            ]
            certain = sizes.get((target, None), unknown) <= self._per_target
            if (certain and max(labels, default=unknown) <= self._per_label) != default:
                others.add(target)
        return GuaranteedTargets(default, frozenset(others))

    def _keep(self, outcome: Outcome) -> None:
        for key in _keys(outcome):
            # Sorted, so that those below an index are counted by bisection.
            insort(self._kept[key], outcome.index)

    def _open_below(self, index: int) -> int:
        below = sum(reported < index for reported in self._beyond)
        return max(0, index - self._frontier - below)

    def _is_certain(self, outcome: Outcome) -> bool:
        index = outcome.index
        unknown = self._open_below(outcome.index)
        for key, quota in zip(
            _keys(outcome), (self._per_target, self._per_label), strict=True
        ):
            waiting = sum(
                other.index < index and key in _keys(other)
                for other in self._waiting.values()
            )
            if bisect_left(self._kept[key], index) + waiting + unknown >= quota:
                return False
        return True


def _keys(outcome: Outcome) -> tuple[tuple[str, str | None], tuple[str, str | None]]:
    return (outcome.target, None), (outcome.target, outcome.label)
