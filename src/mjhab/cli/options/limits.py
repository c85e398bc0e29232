"""Ranges of options by type and name, checked for every command before it starts."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

from mjhab.core.errors import UsageError
from mjhab.core.files.outputs import check_output

MAX_NUMBER = 10**9
MAX_TEXT_CHARACTERS = 1000
MAX_FILTER_CHARACTERS = 10_000
FILTERS = ("where", "keep")
MAX_PATH_CHARACTERS = 4096
INT_RANGES: dict[str, tuple[int, int]] = {
    "seed": (0, 2**63 - 1),
    "worlds": (1, 65_536),
    "num_envs": (1, 10_000_000),
    "workers": (0, 256),
    "threads": (0, 1024),
    "episodes": (0, 100_000_000),
    "films": (0, 10_000),
    "width": (0, 8192),
    "height": (0, 8192),
    "camera_size": (1, 4096),
    "max_message_mb": (0, 4096),
}
"""Least and largest value of integer options by name; other options range from 0 to `MAX_NUMBER`. Commands check
narrower ranges themselves."""
OUTPUTS = ("out", "page", "export", "log", "record")
"""Options that name output files or folders."""


def check_limits(options: Any) -> None:
    """Refuse option values that are invalid for every command.

    Args:
        options: dataclass of a command's options.

    Raises:
        UsageError: a value is out of range; the message names the option, the range and the value.
    """
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        for one in value if isinstance(value, tuple) else (value,):
            _check(field.name, one)
        if field.name in OUTPUTS and isinstance(value, Path):
            check_output(value, _shown(field.name))


def _check(name: str, value: Any) -> None:
    if isinstance(value, bool) or value is None:
        return
    if isinstance(value, int):
        least, most = INT_RANGES.get(name, (0, MAX_NUMBER))
        _check_range(name, value, least, most)
    elif isinstance(value, float):
        if math.isnan(value):
            raise UsageError(f"{_shown(name)} must be a number, got {value}.")
        _check_range(name, value, 0, MAX_NUMBER)
    elif isinstance(value, str | Path):
        most = MAX_PATH_CHARACTERS if isinstance(value, Path) else MAX_TEXT_CHARACTERS
        if name in FILTERS:
            most = MAX_FILTER_CHARACTERS
        _check_text(name, str(value), most)


def _check_range(name: str, value: float, least: int, most: int) -> None:
    if value < least:
        raise UsageError(f"{_shown(name)} must be at least {least:,}, got {value}.")
    if value > most:
        raise UsageError(f"{_shown(name)} must be at most {most:,}, got {value}.")


def _check_text(name: str, text: str, most: int) -> None:
    if len(text) > most:
        raise UsageError(
            f"{_shown(name)} is {len(text):,} characters long; at most {most:,} are read."
        )
    if "\0" in text:
        raise UsageError(f"{_shown(name)} holds a NUL character.")


def _shown(name: str) -> str:
    return f"--{name.replace('_', '-')}"
