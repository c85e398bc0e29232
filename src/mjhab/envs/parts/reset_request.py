"""The seeds and episodes that a caller of ``reset`` asks for, checked."""

from __future__ import annotations

import operator
from typing import Any

from mjhab.config.env import EnvConfig
from mjhab.core.errors import wrong_value
from mjhab.core.typed.checks import check
from mjhab.core.typed.options import taken

MAX_INDEX = 1 << 62
"""Indices of episodes are below it."""


def seeds_of(seed: Any, num_worlds: int) -> list[int | None]:
    """The seed of every world, None for one that keeps its own.

    Args:
        seed: one for all worlds, or one each.
        num_worlds: W.

    Raises:
        UsageError: one is no number from 0, or there are not W.
    """
    given = _listed(seed)
    seeds = [
        None if each is None else taken(EnvConfig, "seed", each)
        for each in ([seed] * num_worlds if given is None else given)
    ]
    check(
        len(seeds) == num_worlds,
        "seed",
        seed,
        f"a number >= 0 or {num_worlds} of them, one per world",
    )
    return seeds


def indices_of(wanted: Any, count: int) -> list[int]:
    """The indices of ``count`` episodes, one per reset world.

    Raises:
        UsageError: they are not whole numbers from 0, or not so many.
    """
    listed = _listed(wanted) or []
    # All at once, so that one message covers kind and number.
    given = [index for index in map(_index, listed) if index is not None]
    if not len(given) == len(listed) == count:
        raise wrong_value(
            "options['episode']", wanted, f"{count} indices >= 0, one per reset world"
        )
    return given


def _listed(values: Any) -> list[Any] | None:
    """The items of a list or array; None for a single value and for texts."""
    try:
        return None if isinstance(values, str) else list(values)
    except TypeError:
        return None


def _index(value: Any) -> int | None:
    """A whole number that an episode can have; None for anything else."""
    try:
        # True would count as episode 1; `index` refuses floats, which would be cut off.
        index = -1 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        return None
    return index if 0 <= index < MAX_INDEX else None
