"""Limits of options by type and name, checked for every command before it starts. Commands check narrower ones
themselves."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

from mjhab.config.ranges import MAX_NUMBER, check_range, range_of
from mjhab.core.errors import UsageError
from mjhab.core.files.outputs import check_file, check_output

MAX_TEXT_CHARACTERS = 1000
MAX_FILTER_CHARACTERS = 10_000
FILTERS = ("where", "keep")
MAX_PATH_CHARACTERS = 4096
OUTPUTS = ("out", "page", "export", "log", "record")
"""Options that name output files or folders."""

KINDS = {"page": ".md", "export": ".html", "record": ".h5"}
"""Options that name a file of one kind, and how its name ends."""


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
            if field.name in KINDS:
                check_file(value, KINDS[field.name], _shown(field.name))


def _check(name: str, value: Any) -> None:
    if isinstance(value, bool) or value is None:
        return
    if isinstance(value, int):
        check_range(_shown(name), value, *range_of(name))
    elif isinstance(value, float):
        if math.isnan(value):
            raise UsageError(f"{_shown(name)} must be a number, got {value}.")
        check_range(_shown(name), value, 0, MAX_NUMBER)
    elif isinstance(value, str | Path):
        most = MAX_PATH_CHARACTERS if isinstance(value, Path) else MAX_TEXT_CHARACTERS
        if name in FILTERS:
            most = MAX_FILTER_CHARACTERS
        _check_text(name, str(value), most)


def _check_text(name: str, text: str, most: int) -> None:
    if len(text) > most:
        raise UsageError(
            f"{_shown(name)} is {len(text):,} characters long; at most {most:,} are read."
        )
    if "\0" in text:
        raise UsageError(f"{_shown(name)} holds a NUL character.")


def _shown(name: str) -> str:
    return f"--{name.replace('_', '-')}"
