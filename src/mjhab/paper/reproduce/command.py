"""``mjhab reproduce``: train and evaluate policies for results of the MS-HAB paper."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from mjhab.cli.exits import INTERRUPTED, stopped
from mjhab.cli.options.policies.reproduce import ReproduceOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.cli.policies.evaluate import ProgressSink
from mjhab.core.files.interrupts import sigterm_interrupts
from mjhab.paper.reproduce.make import reproduce
from mjhab.paper.reproduce.results import REPORT, TITLES, cells, titles
from mjhab.paper.reproduce.spec import TableSpec


def run_reproduce(options: ReproduceOptions) -> int:
    """Run the command; returns 0, or 130 after Ctrl-C or SIGTERM (finished parts are kept)."""
    spec = table_spec(options)
    with sigterm_interrupts():
        results, interrupted = reproduce(
            spec,
            lambda judging: [ProgressSink(judging)],
            lambda row: print(f"mjhab: {row.name}", file=sys.stderr),
        )
    tell(options, results, interrupted)
    return INTERRUPTED if interrupted else 0


def table_spec(options: ReproduceOptions) -> TableSpec:
    """Convert the options to a `TableSpec`.

    Raises:
        UsageError: a number is out of range.
    """
    least = {"episodes": 1, "worlds": 1, "workers": 1}
    for name in (*least, "films", "seed", "threads", "demos", "updates"):
        at_least(name, getattr(options, name), least.get(name, 0))
    at_least("budget-minutes", options.budget_minutes, 0)
    return TableSpec(
        what=options.what,
        out=options.out,
        rows=options.rows,
        variants=options.variants,
        preset=options.preset,
        column=options.column,
        policies=options.policies,
        backend=options.backend,
        device=options.device,
        demos=options.demos,
        updates=options.updates,
        workers=options.workers,
        budget_minutes=options.budget_minutes,
        profile=options.profile,
        robot=options.robot,
        starts=options.starts,
        stillness=options.stillness,
        joint_dynamics=options.joint_dynamics,
        split=options.split,
        episodes=options.episodes,
        films=options.films,
        seed=options.seed,
        assets=options.assets,
        worlds=options.worlds,
        threads=options.threads,
        resume=options.resume,
    )


def tell(
    options: ReproduceOptions, results: Sequence[Mapping[str, Any]], interrupted: bool
) -> None:
    """Print the table, or its JSON."""
    if interrupted:
        stopped(f"finished parts are kept in {options.out}")
    if options.json:
        print_json({"rows": list(results), "report": str(options.out / REPORT)})
        return
    title = f"{TITLES[options.what]}, {options.column}, split {options.split}"
    print_table(title, titles(), [cells(result) for result in results])
    print(f"report: {options.out / REPORT}")
