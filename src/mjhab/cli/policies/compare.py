"""``mjhab compare``: runs beside each other."""

from __future__ import annotations

from mjhab.cli.output import Listing, report
from mjhab.evaluation.compare import CompareSpec, Comparison, run_comparison
from mjhab.reports.compared.page import pair_words
from mjhab.reports.words import percent


def run_compare(spec: CompareSpec, json: bool) -> int:
    """Run the command; returns 0."""
    found = run_comparison(spec)
    report(json, found.as_json(), *_listings(found))
    return 0


def _listings(found: Comparison) -> list[Listing | str]:
    page = f"report: {found.report}"
    if found.trainings:
        rows = [
            (name, "-" if rate is None else percent(rate))
            for name, rate in found.trainings.items()
        ]
        return [Listing("Training runs", ("run", "last success once"), rows), page]
    runs = [
        (
            run.name,
            len(run.records),
            percent(run.success_once),
            " to ".join(map(percent, run.bounds)),
        )
        for run in found.runs
    ]
    columns = ("run", "episodes", "success once", "95 % interval")
    parts: list[Listing | str] = [Listing("Runs", columns, runs)]
    parts += map(pair_words, found.pairs)
    changes = [
        (pair.a, pair.b, before, after, count)
        for pair in found.pairs
        for before, after, count in pair.found.labels
    ]
    if changes:
        heads = ("A", "B", "label in A", "label in B", "subtasks")
        parts.append(Listing("Labels that change", heads, changes))
    return [*parts, *found.cautions, page]
