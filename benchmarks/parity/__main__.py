"""Divergence of the two simulators, and agreement of their outcomes, labels and rewards."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from benchmarks.command import run_command
from benchmarks.parity.episodes import KINDS
from benchmarks.parity.run import NOT_COMPARED, ParitySpec, measure_parity
from mjhab.cli.output import print_json, print_table


def bench_parity(spec: ParitySpec) -> int:
    """Print the results of `measure_parity`."""
    found = measure_parity(spec)
    if spec.json:
        print_json(found)
        return 0
    marks = [f"step {mark}" for mark in found["steps"]]
    for name, title in (
        ("max", "largest difference in any world"),
        ("median", "median over the worlds"),
    ):
        rows = [
            [
                f"{kind} [{KINDS[kind]}]",
                *(f"{x:.2g}" for x in found[f"qpos_{name}"][kind]),
            ]
            for kind in KINDS
        ]
        print_table(title, ("what", *marks), rows)
    for acting, title in (
        ("equal", "the same actions"),
        ("own", "the expert on each by itself"),
    ):
        legs = found[f"episodes_{acting}"]
        if legs:
            print_table(
                f"share that agrees, {title}",
                ("what", *next(iter(legs.values()))),
                [[name, *shares.values()] for name, shares in legs.items()],
            )
    print_table("agreement", ("what", "share"), list(found["agree"].items()))
    if found["grasps"]:
        rows = [
            [
                row["object"],
                *(row[b][key] for b in ("cpu", "warp") for key in ("slip_mm", "dropped")),
            ]
            for row in found["grasps"]
        ]
        columns = (
            "object",
            "cpu slip [mm]",
            "cpu dropped",
            "warp slip [mm]",
            "warp dropped",
        )
        print_table(f"{spec.grasp_seconds:g} s of shaking", columns, rows)
    print(f"Not compared: {NOT_COMPARED}.")
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    minima = {"worlds": 1, "steps": 1}
    return run_command("parity", ParitySpec, bench_parity, words, minima)


if __name__ == "__main__":
    sys.exit(main())
