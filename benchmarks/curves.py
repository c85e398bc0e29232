"""Samples that PPO takes to a rate of success, with our settings and the paper's: ``python -m benchmarks.curves``.

Trains close drawer from the same states with preset "fast" and with "paper_state", the hyper-parameters of the paper.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.command import run_command
from mjhab.cli.output import Listing, report
from mjhab.core.files.cache import write_json
from mjhab.core.files.interrupts import sigterm_interrupts
from mjhab.learning.reinforcement.specs import PpoSpec
from mjhab.learning.reinforcement.train import train_reinforcement
from mjhab.reports.compared.trainings import FINAL

TARGET = "kitchen_counter/drawer3"
PRESETS = ("fast", "paper_state")
LEVELS = (0.5, 0.8)
"""Success once whose first reaching is told."""
EVALUATED_SAMPLES = 100_000
"""Between evaluations, as in the paper."""
EPISODES = 64
"""Of each evaluation; the paper has 189."""
RESULT = "curves.json"


@dataclass(frozen=True)
class CurvesSpec:
    """Train PPO with our settings and with those of the paper, and print the samples to 50 % and 80 % success.

    It takes hours. After a break the same command goes on; finished runs are not run again.
    """

    out: Path = Path("runs/curves")
    """Folder with a training run for every preset and seed, and curves.json."""
    samples: int = 3_000_000
    """Control steps of every run."""
    seeds: int = 3
    """Runs of every preset, with seeds 0, 1, ..."""
    json: bool = False
    """Print one line of JSON instead of a table."""


def measure_curves(spec: CurvesSpec) -> dict[str, Any]:
    """Train all runs, or what is missing of them, and write their results to ``curves.json`` in ``spec.out``.

    Raises:
        UsageError: the folder holds runs of other numbers of samples, or something else.
        KeyboardInterrupt: what is done is kept.

    Returns:
        By preset and seed "curve", pairs of samples and success once, and "samples_to", by level the samples at the
        first evaluation that reaches it, None if none does.
    """
    found: dict[str, Any] = {}
    for preset in PRESETS:
        for seed in range(spec.seeds):
            run = spec.out / f"{preset}_{seed}"
            curve = train_curve(preset, seed, spec.samples, run)
            found[f"{preset}/{seed}"] = {"curve": curve, "samples_to": samples_to(curve)}
            # After every run: all of them take hours.
            write_json(spec.out / RESULT, found)
    return found


def train_curve(
    preset: str, seed: int, samples: int, run: Path
) -> list[tuple[int, float]]:
    """Train one run, or what is missing of it; returns its samples and success at each evaluation.

    Raises:
        KeyboardInterrupt: what is done is kept.
    """
    summary = run / "summary.json"
    if not _is_through(summary, samples):
        spec = PpoSpec(
            out=run,
            preset=preset,
            set=(f"eval_samples={EVALUATED_SAMPLES}",),
            samples=samples,
            env={"subtask": "close", "target": TARGET, "seed": seed},
            eval_episodes=EPISODES,
            round_episodes=EPISODES,
            eval_split="train",
            films=0,
            resume=(run / "config.json").is_file(),
        )
        result = train_reinforcement(spec)
        if result.interrupted:
            raise KeyboardInterrupt
    lines = (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    rows = [json.loads(line) for line in lines]
    return [
        (row["samples"], row["success_once"])
        for row in rows
        # The final evaluation is of the best actor, in other homes.
        if "success_once" in row and row.get("evaluation") != FINAL
    ]


def _is_through(summary: Path, samples: int) -> bool:
    if not summary.is_file():
        return False
    found = json.loads(summary.read_text(encoding="utf-8"))
    # A run that was stopped before its final evaluation has no episodes.
    return found["samples"] >= samples and found["episodes"] > 0


def samples_to(curve: Sequence[tuple[int, float]]) -> dict[str, int | None]:
    """Samples at the first evaluation that reaches each of LEVELS."""
    return {
        str(level): next(
            (samples for samples, success in curve if success >= level), None
        )
        for level in LEVELS
    }


def bench_curves(spec: CurvesSpec) -> int:
    """Print the results of `measure_curves`; returns 0, or 130 after Ctrl-C or SIGTERM."""
    try:
        with sigterm_interrupts():
            found = measure_curves(spec)
    except KeyboardInterrupt:
        print("mjhab: interrupted. The same command goes on.", file=sys.stderr)
        return 130
    columns = [f"samples to {100 * level:.0f} %" for level in LEVELS]
    rows = []
    for name, run in found.items():
        reached = [run["samples_to"][str(level)] or "not reached" for level in LEVELS]
        rows.append((name, *reached, f"{100 * run['curve'][-1][1]:.0f}"))
    title = "PPO, set_table close drawer, success once"
    table = Listing(title, ("run", *columns, "at the end [%]"), rows)
    report(spec.json, {"runs": found, "file": str(spec.out / RESULT)}, table)
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(
        "curves", CurvesSpec, bench_curves, words, {"samples": 1, "seeds": 1}
    )


if __name__ == "__main__":
    sys.exit(main())
