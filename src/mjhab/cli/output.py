"""Output of commands: tables for people, one line of JSON for machines."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mjhab.core.progress import say
from mjhab.rollout.records import skips_text

PIPED_WIDTH = 10_000
"""Width of output that does not go to a terminal [characters]; wider than any table."""
FRAME_WIDTH = 3
"""Border and padding of a column [characters]; one more border ends the table."""


def print_json(value: Mapping[str, Any]) -> None:
    """Print ``value`` as one line on stdout, for machines."""
    # Flushed, because a reader may wait for the line while the command goes on serving.
    print(json.dumps(value, allow_nan=False), flush=True)


def tell_caution(summary: Mapping[str, Any]) -> None:
    """Warn on stderr of a policy, as the configuration or description that records it does, if it does."""
    caution = summary.get("policy_caution")
    if caution:
        say(f"mjhab: {caution}")


class Listing(NamedTuple):
    """A table, as `print_table` takes it."""

    title: str
    columns: Sequence[str]
    rows: Iterable[Sequence[object]]


def listing_of(title: str, rows: Sequence[Mapping[str, Any]]) -> Listing:
    """A table of rows that have the same names, which are its columns."""
    return Listing(title, list(rows[0]), [list(row.values()) for row in rows])


def report(json: bool, facts: Mapping[str, Any], *parts: Listing | str | None) -> None:
    """Print the result of a command: ``facts`` as one line of JSON for machines, or the parts for people.

    Args:
        json: which of the two.
        facts: JSON data.
        *parts: tables and lines; "" and None are left out.
    """
    if json:
        print_json(facts)
        return
    for part in parts:
        if isinstance(part, Listing):
            print_table(*part)
        elif part:
            print(part)


def tell_skipped(skipped: Mapping[str, int]) -> None:
    """Tell on stderr which homes had no room and were skipped, if any; ``skipped``: number of episodes by home."""
    if skipped:
        say(f"mjhab: skipped, because they have no room: {skips_text(skipped)}")


def print_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]
) -> None:
    """Print a table on stdout; numbers are right-aligned.

    In a terminal cells wrap between words. Where the terminal is too narrow for that, every row is a list of its cells.
    Nothing is cut off. Where nobody sees a terminal, every row is one line, as wide as its content.
    """
    rows = [list(row) for row in rows]
    # Without a terminal rich assumes 80 columns, and wrapped rows are hard to search.
    console = Console(width=None if sys.stdout.isatty() else PIPED_WIDTH)
    widths = _widths([columns, *rows], console.width - 1 - FRAME_WIDTH * len(columns))
    if widths is None:
        console.print(Text(title, style="bold"))
        for row in rows:
            console.print(_cells(columns, row))
        return
    table = Table(title=title, title_justify="left", title_style="bold")
    for i, name in enumerate(columns):
        numeric = bool(rows) and all(
            # True and False are ints for Python, but words for a reader.
            isinstance(row[i], int | float) and not isinstance(row[i], bool)
            for row in rows
        )
        table.add_column(
            name, justify="right" if numeric else "left", width=widths[i], overflow="fold"
        )
    for row in rows:
        # As Text, because rich would read brackets in a name as markup.
        table.add_row(*(Text(str(cell)) for cell in row))
    console.print(table)


def _widths(rows: Sequence[Sequence[object]], available: int) -> list[int] | None:
    """Width of every column so that no word is broken, at most ``available`` together; None if that is too little."""
    cells = [[str(row[i]) for row in rows] for i in range(len(rows[0]))]
    widths = [
        max(cell_len(word) for cell in column for word in [*cell.split(), ""])
        for column in cells
    ]
    wanted = [
        max(cell_len(line) for cell in column for line in [*cell.splitlines(), ""])
        for column in cells
    ]
    spare = available - sum(widths)
    if spare < 0:
        return None
    # What a column with a small wish leaves over goes to those with larger ones.
    order = sorted(range(len(widths)), key=lambda i: wanted[i] - widths[i])
    for place, i in enumerate(order):
        more = min(wanted[i] - widths[i], spare // (len(order) - place))
        widths[i] += more
        spare -= more
    return widths


def _cells(columns: Sequence[str], row: Sequence[object]) -> Table:
    """A row as a list, a line per cell, with an empty line after it; words wider than the terminal are broken."""
    cells = Table.grid("", "", padding=(0, 2, 0, 0))
    cells.columns[1].overflow = "fold"
    for name, cell in zip(columns, row, strict=True):
        cells.add_row(Text(name, style="bold"), Text(str(cell)))
    cells.add_row()
    return cells
