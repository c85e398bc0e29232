"""``mjhab bench curves``: samples of PPO to a rate of success, with our settings and the paper's."""

from __future__ import annotations

import sys

from mjhab.cli.interrupts import sigterm_interrupts
from mjhab.cli.options.policies.benches import BenchCurvesOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.learning.require import require_learn


def bench_curves(options: BenchCurvesOptions) -> int:
    """Print the results of `measure_curves`; returns 0, or 130 after Ctrl-C or SIGTERM.

    Raises:
        UsageError: a number is out of range, or the folder holds other runs.
    """
    for name in ("samples", "seeds"):
        at_least(name, getattr(options, name), 1)
    require_learn()
    from mjhab.bench.training.curves import LEVELS, RESULT, measure_curves

    try:
        with sigterm_interrupts():
            found = measure_curves(options)
    except KeyboardInterrupt:
        print("mjhab: interrupted. The same command goes on.", file=sys.stderr)
        return 130
    if options.json:
        print_json({"runs": found, "file": str(options.out / RESULT)})
        return 0
    columns = [f"samples to {100 * level:.0f} %" for level in LEVELS]
    rows = []
    for name, run in found.items():
        reached = [run["samples_to"][str(level)] or "not reached" for level in LEVELS]
        rows.append((name, *reached, f"{100 * run['curve'][-1][1]:.0f}"))
    print_table(
        "PPO, set_table close drawer, success once",
        ("run", *columns, "at the end [%]"),
        rows,
    )
    return 0
