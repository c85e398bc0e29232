"""Bounds of single fields, in their annotations: ``Annotated[int, Bound(least=0)]``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mjhab.core.typed.flags import mark_of


@dataclass(frozen=True)
class Bound:
    """What values a field may have, where that is not what is usual for its type.

    least: smallest number, also of the items of a tuple; None for the usual one: 1 of whole numbers, 0 of others.
    empty: whether a tuple may have no items.
    """

    least: float | None = None
    empty: bool = False

    def least_of(self, value: float) -> float:
        """Smallest number for a field that has such values."""
        if self.least is not None:
            return self.least
        return 1 if isinstance(value, int) else 0


def bound_of(owner: type[Any], name: str) -> Bound:
    """The bound of a field of a dataclass."""
    return mark_of(owner, name, Bound) or Bound()
