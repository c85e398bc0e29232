"""What is said on stderr: lines of text, and progress bars where a person looks on."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)


def say(text: str) -> None:
    """Print one line on stderr. Where it cannot be written (closed pipe, full disk), the work goes on without it."""
    with suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


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
        # A log file would get a line for every change.
        *columns,
        console=console,
        transient=True,
        disable=not console.is_terminal,
    ) as progress:
        bar = progress.add_task(what, total=total)
        yield lambda: progress.advance(bar)


def work_bar(note: str = "{task.fields[note]}") -> Progress:
    """A bar on stderr of work whose tasks are added by `Progress.add_task`.

    Args:
        note: what stands behind the numbers, a text of rich with fields of the task.
    """
    return Progress(
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TextColumn(note),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=Console(stderr=True),
    )


@contextmanager
def late_bar(what: str) -> Iterator[Callable[[int], Callable[[], None]]]:
    """A bar that is begun by whoever learns how long it will be; gives what `progress_bar` gives."""
    with ExitStack() as stack:
        yield lambda total: stack.enter_context(progress_bar(what, total))
