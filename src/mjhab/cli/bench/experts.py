"""``mjhab bench experts``: the table of success rates of the scripted experts, and of whole tasks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from mjhab.bench.experts.rows import CHAIN, ExpertRow, RowResult
from mjhab.bench.experts.run import REPORT, Measured, Measurement, measure_experts
from mjhab.bench.specs import ExpertsSpec
from mjhab.cli.exits import INTERRUPTED, stopped
from mjhab.cli.output import Listing, report
from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.files.interrupts import stop_signals
from mjhab.core.progress import say

CHAIN_WEIGHT = 8.0
"""Duration of a whole task in units of a single subtask, for the estimate of the remaining time."""


def bench_experts(spec: ExpertsSpec, json: bool) -> int:
    """Run the command; returns 0, 1 if a row could not be measured, or 130 after Ctrl-C or SIGTERM."""
    begun = time.perf_counter()
    with stop_signals() as is_stopped:
        found = measure_experts(spec, is_stopped, _progress)
    _tell(spec, found, time.perf_counter() - begun, json)
    # A row that failed is an error even where the run was stopped later.
    return 1 if found.errors else INTERRUPTED if found.left else 0


@contextmanager
def _progress(measured: Measured) -> Iterator[Callable[[ExpertRow, int], None]]:
    """Show a progress bar over all rows on stderr; yields a function that sets a row's number of finished episodes."""
    columns = (
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=10),
        MofNCompleteColumn(),
        TextColumn("{task.fields[what]}"),
    )
    done = {row: len(found) for row, found in measured.items()}
    first = _weight(done)
    begun = time.perf_counter()
    whole = _weight({row: row.episodes for row in measured})
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(
            "experts",
            total=sum(row.episodes for row in measured),
            completed=sum(done.values()),
            what="",
        )

        def tell(row: ExpertRow, count: int) -> None:
            done[row] = count
            hours = (time.perf_counter() - begun) / 3600
            gained = _weight(done) - first
            what = ""
            # Rows that an earlier run measured say nothing about the speed of this one.
            if gained > 0:
                left = round((whole - first - gained) * hours / gained * 60)
                what = f"{gained / hours:,.0f}/h, {left // 60} h {left % 60:02d} min left"
            bar.update(
                task, description=row.name, completed=sum(done.values()), what=what
            )

        yield tell


def _weight(counts: Mapping[ExpertRow, int]) -> float:
    """Work of the given numbers of episodes per row, in units of single subtasks."""
    return ordered_sum(
        count * (CHAIN_WEIGHT if row.subtask == CHAIN else 1.0)
        for row, count in counts.items()
    )


def _tell(spec: ExpertsSpec, found: Measurement, seconds: float, json: bool) -> None:
    for row, error in found.errors.items():
        say(f"mjhab: {row.name} could not be measured: {error}")
    if found.left:
        stopped(f"{found.left} episodes are left")
    of = f"{spec.asked.split}, profile {spec.asked.profile}"
    parts = _singles([r for r in found.results if r.subtask != CHAIN], of)
    chains = [result for result in found.results if result.subtask == CHAIN]
    if chains:
        columns = (
            "chain",
            "n",
            "complete",
            "95 %",
            "asked",
            "completed 1, 2, ... subtasks",
        )
        title = f"Progressive completion, {of} [%]"
        parts.append(Listing(title, columns, map(_chain_cells, chains)))
    page = f"report: {spec.out / REPORT}"
    report(json, _summary(spec, found, seconds), *parts, page)


def _summary(spec: ExpertsSpec, found: Measurement, seconds: float) -> dict[str, Any]:
    """The measurement as JSON data."""
    results = found.results
    return {
        "profile": spec.asked.profile,
        "rows": len(results),
        "episodes": sum(result.episodes for result in results),
        "success_once": {name_of(result): result.success_once for result in results},
        "below_asked": [name_of(result) for result in results if result.met is False],
        "tainted": sum(result.tainted for result in results),
        "failed_rows": [row.name for row in found.errors],
        "left": found.left,
        "seconds": round(seconds, 1),
        "out": str(spec.out),
    }


def _singles(singles: Sequence[RowResult], of: str) -> list[Listing]:
    """One table per pack and task; ``of``: which homes and profile."""
    columns = ("subtask", "target", "n", "once", "95 %", "< 1,400 N", "asked", "paper")
    tables = []
    for pack, task in dict.fromkeys((result.pack, result.task) for result in singles):
        rows = [_cells(r) for r in singles if (r.pack, r.task) == (pack, task)]
        title = f"{task}, {pack} homes, {of}: success once [%]"
        tables.append(Listing(title, columns, rows))
    return tables


def name_of(result: RowResult) -> str:
    """Name of a row in the JSON output."""
    words = (result.pack, result.task, result.subtask, result.target, result.navigate)
    return " ".join(filter(None, words))


def _cells(r: RowResult) -> tuple[object, ...]:
    rates = (
        _text(r.success_once),
        _interval(r),
        _text(r.gentle),
        _text(r.asked),
        _text(r.paper),
    )
    return r.subtask, r.target, r.episodes, *rates


def _chain_cells(r: RowResult) -> tuple[object, ...]:
    curve = " ".join(f"{100 * share:.0f}" for share in r.progressive)
    return (
        f"{r.pack} {r.task}, {r.navigate}",
        r.episodes,
        _text(r.success_once),
        _interval(r),
        _text(r.asked),
        curve,
    )


def _text(rate: float | None) -> str:
    return "-" if rate is None else f"{100 * rate:.1f}"


def _interval(r: RowResult) -> str:
    low, high = r.interval
    return f"{100 * low:.0f} to {100 * high:.0f}" if r.episodes else "-"
