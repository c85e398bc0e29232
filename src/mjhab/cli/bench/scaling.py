"""``mjhab bench scaling``: speed over numbers of worlds and threads."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

from mjhab.bench.simulation.scaling import (
    MEASURED,
    MOST_CELLS,
    measure_scaling,
    threads_of,
)
from mjhab.cli.options.engine import BenchScalingOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.core.errors import UsageError
from mjhab.core.machine import cores
from mjhab.robots.registry import DEFAULT_ROBOT


def bench_scaling(options: BenchScalingOptions) -> int:
    """Print the results of `measure_scaling`.

    Raises:
        UsageError: a number is out of range, or there are too many combinations.
    """
    if not options.worlds:
        raise UsageError(
            "--worlds: give at least one number of worlds, for instance --worlds 1 16 256."
        )
    for name in ("worlds", "threads"):
        for number in getattr(options, name):
            at_least(name, number, 1)
    at_least("rounds", options.rounds, 1)
    at_least("seed", options.seed, 0)
    cells = len(options.worlds) * len(options.threads or threads_of(cores()))
    if cells > MOST_CELLS:
        raise UsageError(
            f"{cells} combinations of --worlds and --threads; at most {MOST_CELLS}."
        )
    found = measure_scaling(options, _told)
    if options.json:
        print_json(found)
        return 0
    robot = options.robot or DEFAULT_ROBOT
    print_table(
        f"{options.task}, {robot}, control steps/s over all worlds",
        ("threads", "worlds", "engine", "environment", "environment / engine"),
        [_cells(row) for row in found["rows"]],
    )
    print_table(
        "Time of a vector step [microseconds]: fixed + worlds x (serial + parallel / threads)",
        ("what", "fixed", "serial", "parallel", "largest error"),
        [(name, *found["models"][name].values()) for name in MEASURED],
    )
    print_table(
        "Predicted from it, not measured: control steps/s",
        ("cores", "worlds", "engine", "environment"),
        [tuple(row.values()) for row in found["predicted"]],
    )
    return 0


def _cells(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return (
        row["threads"],
        row["worlds"],
        row["engine_sps"],
        row["env_sps"],
        row["ratio"],
    )


def _told(row: Mapping[str, Any]) -> None:
    """Tell how far the measurement is."""
    print(
        f"mjhab: {row['threads']} threads, {row['worlds']} worlds: engine {row['engine_sps']:,.0f}, "
        f"environment {row['env_sps']:,.0f} control steps/s",
        file=sys.stderr,
    )
