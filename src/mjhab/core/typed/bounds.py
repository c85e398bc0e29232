"""Bounds of single fields, in their annotations: ``Annotated[int, Bound(least=1)]``, ``Annotated[Path, Output()]``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from mjhab.core.errors import wrong_value
from mjhab.core.files.outputs import check_file, check_output
from mjhab.core.typed.flags import mark_of

MAX_NUMBER = 10**9
"""Largest value of a field that has no bound of its own."""


@dataclass(frozen=True)
class Bound:
    """What numbers a field may have, or the items of its tuple.

    least, most: smallest and largest. empty: whether a tuple may have no items.
    """

    least: float = 0
    most: float = MAX_NUMBER
    empty: bool = True


@dataclass(frozen=True)
class Output:
    """A file or folder that is written to.

    suffix: how the name of a file ends, e.g. ".html"; "" for any, and for folders.
    """

    suffix: str = ""


Positive = Annotated[int, Bound(1)]
"""A whole number of at least 1."""
# Seeds are stored in int64 columns.
SEED = Bound(0, 2**63 - 1)
"""Of the seed of a stream (`core.seeding`)."""


def bound_of(owner: type[Any], name: str) -> Bound:
    """The bound of a field of a dataclass."""
    return mark_of(owner, name, Bound) or Bound()


def check_value(owner: type[Any], name: str, value: Any, label: str = "") -> None:
    """Refuse a value that the marks of a field forbid.

    Args:
        owner: the dataclass.
        name: of the field.
        value: of the type of the field.
        label: how the message names it; "" for ``name``.

    Raises:
        UsageError: a number is out of its bound, or an output cannot be written.
    """
    label = label or name
    check_bound(label, value, bound_of(owner, name))
    output = mark_of(owner, name, Output)
    if output is not None and isinstance(value, Path):
        option = f"--{label.replace('_', '-')}"
        check_output(value, option)
        if output.suffix:
            check_file(value, output.suffix, option)


def check_bound(label: str, value: Any, bound: Bound) -> None:
    """Refuse numbers out of a bound; other values pass.

    Raises:
        UsageError: names the field as ``label``.
    """
    if isinstance(value, tuple):
        if not value and not bound.empty:
            raise wrong_value(label, value, "at least one value")
        for one in value:
            check_bound(label, one, bound)
        return
    # True would count as 1.
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    # Not (value < least): a NaN is in no bound.
    if not value >= bound.least:
        raise wrong_value(label, value, f"at least {bound.least:,}")
    if not value <= bound.most:
        raise wrong_value(label, value, f"at most {bound.most:,}")
