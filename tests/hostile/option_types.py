"""The options of all commands, and values that none of them can work with."""

from __future__ import annotations

import math
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mjhab.cli import commands
from mjhab.cli.parsing import flat_options

BAD: dict[type, tuple[Any, ...]] = {
    int: (-1, 2**63, 2**64, -(2**70)),
    float: (-1.0, math.nan, math.inf, 1e300),
    str: ("x" * 20_000, "a\0b"),
    Path: (Path("x" * 20_000), Path("a\0b")),
}
OUTPUTS = ("out", "page", "export", "log", "record")
BAD_OUTPUTS = (
    Path("/proc/mjhab/x"),
    Path("/dev/null"),
    Path("/dev/null/x"),
    Path("x" * 300),
)


def option_classes() -> list[type]:
    """The option dataclasses of all commands."""
    found = []
    for command in commands.COMMANDS:
        options = commands.load(command.options)
        found.append(flat_options(command, options) if command.spec else options)
    return found


def values_of(options: type) -> Iterator[tuple[str, Any]]:
    """Names of options with values out of all range, by type."""
    for name, hint in typing.get_type_hints(options).items():
        kinds = set(_plain(hint))
        for kind, values in BAD.items():
            if kind in kinds:
                yield from ((name, value) for value in values)
        if name in OUTPUTS:
            yield from ((name, value) for value in BAD_OUTPUTS)


def _plain(hint: Any) -> Iterator[type]:
    """The types in a hint, e.g. int of ``tuple[int, ...] | None``."""
    parts = typing.get_args(hint)
    if not parts:
        yield hint
    for part in parts:
        yield from _plain(part)
