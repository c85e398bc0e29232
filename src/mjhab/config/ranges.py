"""Ranges of whole numbers that options may have, by name; commands and the Python API check the same ones."""

from __future__ import annotations

from numbers import Integral
from typing import Any

from mjhab.core.errors import wrong_type, wrong_value

MAX_NUMBER = 10**9
"""Largest value of an option that has no range of its own."""
RANGES: dict[str, tuple[int, int]] = {
    "seed": (0, 2**63 - 1),
    "check_seed": (0, 2**63 - 1),
    "port": (0, 65_535),
    "worlds": (1, 65_536),
    "num_envs": (1, 10_000_000),
    "workers": (0, 256),
    "threads": (0, 1024),
    "episodes": (0, 100_000_000),
    "films": (0, 10_000),
    "width": (0, 8192),
    "height": (0, 8192),
    "camera_size": (1, 4096),
    "frame_stack": (1, 256),
    "max_message_mb": (0, 4096),
}
"""Least and largest value by name; options that are not here range from 0 to `MAX_NUMBER`."""


def range_of(name: str) -> tuple[int, int]:
    """Least and largest value of an option."""
    return RANGES.get(name, (0, MAX_NUMBER))


def check_range(shown: str, value: float, least: float, most: float) -> None:
    """Refuse a number out of its range.

    Args:
        shown: the option as the message names it.

    Raises:
        UsageError: the number is too small or too large.
    """
    if value < least:
        raise wrong_value(shown, value, f"at least {least:,}")
    if value > most:
        raise wrong_value(shown, value, f"at most {most:,}")


def whole_number(name: str, value: Any, least: int | None = None) -> int:
    """The value of an option as an int, if it is in its range.

    Args:
        name: of the option.
        value: an int or an integer of numpy.
        least: a larger least value than that of the range.

    Raises:
        UsageError: no whole number, or out of its range.
    """
    low, most = range_of(name)
    low = low if least is None else least
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise wrong_type(name, value, f"a whole number of at least {low:,}")
    check_range(name, int(value), low, most)
    return int(value)
