"""Output of commands: tables for people, one line of JSON for machines."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mjhab.core.errors import UsageError

PIPED_WIDTH = 10_000
"""Width of output that does not go to a terminal [characters]; wider than any table."""


def print_json(value: Mapping[str, Any]) -> None:
    """Print ``value`` as one line on stdout, for machines."""
    print(json.dumps(value, allow_nan=False), flush=True)


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table on stdout; numbers are right-aligned.

    In a terminal cells wrap, so that nothing is cut off; otherwise every row is one line, as wide as its content.
    """
    rows = [list(row) for row in rows]
    table = Table(title=title, title_justify="left", title_style="bold")
    for i, name in enumerate(columns):
        numeric = bool(rows) and all(
            isinstance(row[i], int | float) and not isinstance(row[i], bool) for row in rows
        )
        table.add_column(name, justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(str(cell)) for cell in row))
    Console(width=None if sys.stdout.isatty() else PIPED_WIDTH).print(table)


def at_least(option: str, value: float, least: float) -> None:
    """Refuse a number below ``least``.

    Raises:
        UsageError: the number is too small.
    """
    if value < least:
        raise UsageError(f"--{option} must be at least {least}, got {value}.")
