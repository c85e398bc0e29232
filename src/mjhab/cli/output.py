"""How commands talk: tables for people, one line of JSON for machines."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from mjhab.core.errors import UsageError


def print_json(value: Mapping[str, Any]) -> None:
    """Print ``value`` as one line on stdout, for machines."""
    print(json.dumps(value, allow_nan=False), flush=True)


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table on stdout; numbers stand on the right."""
    rows = [list(row) for row in rows]
    table = Table(title=title, title_justify="left", title_style="bold")
    for i, name in enumerate(columns):
        numeric = bool(rows) and all(
            isinstance(row[i], int | float) and not isinstance(row[i], bool) for row in rows
        )
        table.add_column(name, justify="right" if numeric else "left")
    for row in rows:
        table.add_row(*(Text(str(cell)) for cell in row))
    Console().print(table)


def at_least(option: str, value: float, least: float) -> None:
    """Refuse a number below ``least``.

    Raises:
        UsageError: it is below.
    """
    if value < least:
        raise UsageError(f"--{option} must be at least {least}, got {value}.")


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a bar on stderr where a person looks on; gives a function that moves it by one."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as progress:
        bar = progress.add_task(what, total=total)
        yield lambda: progress.advance(bar)


@contextmanager
def late_bar(what: str) -> Iterator[Callable[[int], Callable[[], None]]]:
    """A bar that is begun by whoever learns how long it will be; gives what `progress_bar` gives."""
    with ExitStack() as stack:
        yield lambda total: stack.enter_context(progress_bar(what, total))
