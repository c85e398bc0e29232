"""``mjhab reproduce``: train and evaluate policies for results of the MS-HAB paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mjhab.cli.exits import INTERRUPTED, stopped
from mjhab.cli.output import Listing, report
from mjhab.cli.policies.evaluate import ProgressSink
from mjhab.core.files.interrupts import sigterm_interrupts
from mjhab.core.progress import say
from mjhab.paper.reproduce.make import reproduce
from mjhab.paper.reproduce.means import means
from mjhab.paper.reproduce.results import REPORT, TITLES, all_cells, titles
from mjhab.paper.reproduce.spec import TableSpec
from mjhab.scenes.packs import stage_of


def run_reproduce(spec: TableSpec, json: bool) -> int:
    """Run the command; returns 0, or 130 after Ctrl-C or SIGTERM (finished parts are kept)."""
    with sigterm_interrupts():
        results, interrupted = reproduce(
            spec,
            lambda judging: [ProgressSink(judging)],
            lambda row: say(f"mjhab: {row.name}"),
        )
    tell(spec, results, interrupted, json)
    return INTERRUPTED if interrupted else 0


def tell(
    spec: TableSpec, results: Sequence[Mapping[str, Any]], interrupted: bool, json: bool
) -> None:
    """Print the table, or its JSON."""
    if interrupted:
        stopped(f"finished parts are kept in {spec.out}")
    page = spec.out / REPORT
    title = f"{TITLES[spec.what]}, {spec.column}, split {spec.asked.split}"
    table = Listing(title, titles(), all_cells(results))
    stage = stage_of(spec.asked.assets)
    facts = {"rows": list(results), "means": means(results), **stage, "report": str(page)}
    told = f"stage: {stage['stage']}" if stage else None
    report(json, facts, table, told, f"report: {page}")
