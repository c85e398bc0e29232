"""``mjhab bench parity``: divergence of the two simulators, and agreement of their outcomes, labels and rewards."""

from __future__ import annotations

from mjhab.bench.parity.episodes import KINDS
from mjhab.bench.parity.run import NOT_COMPARED, measure_parity
from mjhab.cli.options.gpu import BenchParityOptions
from mjhab.cli.output import at_least, print_json, print_table


def bench_parity(options: BenchParityOptions) -> int:
    """Print the results of `measure_parity`."""
    for name in ("worlds", "steps"):
        at_least(name, getattr(options, name), 1)
    for name in ("episodes", "threads", "seed"):
        at_least(name, getattr(options, name), 0)
    at_least("grasp-seconds", options.grasp_seconds, 0.0)
    found = measure_parity(options)
    if options.json:
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
        print_table(f"{options.grasp_seconds:g} s of shaking", columns, rows)
    print(f"Not compared: {NOT_COMPARED}.")
    return 0
