"""Indices of the episodes that are left of a run, without a list of them: a run may name a hundred million."""

from __future__ import annotations

from collections.abc import Collection, Iterator


class IndicesLeft(Collection[int]):
    """The indices from 0 to N-1 without those that are done, in ascending order.

    Args:
        episodes: number N.
        done: indices to leave out; others than 0 to N-1 do not matter.
    """

    def __init__(self, episodes: int, done: Collection[int] = ()) -> None:
        self._all = range(episodes)
        # A resumed run may ask for fewer episodes than were done.
        self._done = frozenset(index for index in done if index in self._all)

    def __len__(self) -> int:
        return len(self._all) - len(self._done)

    def __iter__(self) -> Iterator[int]:
        return (index for index in self._all if index not in self._done)

    def __contains__(self, index: object) -> bool:
        return index in self._all and index not in self._done
