"""Speed over numbers of worlds and threads, and what follows from it for more cores."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import nnls

from benchmarks.command import run_command
from benchmarks.sim import SimSpec, measure_engine
from mjhab.cli.output import Listing, report
from mjhab.core.errors import UsageError
from mjhab.core.machine import cores
from mjhab.robots.registry import DEFAULT_ROBOT

WORLD_STEPS = 4000
LONGEST_BLOCK = 200
SHORTEST_BLOCK = 10
"""Control steps of a block: about WORLD_STEPS over all worlds, within these limits."""
PREDICTED_CORES = (4, 8, 16, 32, 64)
MAX_CELLS = 100
"""Largest number of combinations that one run measures."""
MEASURED = ("engine", "env")


@dataclass(frozen=True)
class StepTime:
    """Model of the time of a vector step: ``fixed + worlds * (serial + parallel / threads)``, all in seconds.

    fixed: of every vector step. serial: of every world, one after the other. parallel: of every world, shared by the
    threads. error: largest relative difference between the model and a measured time.
    """

    fixed: float
    serial: float
    parallel: float
    error: float

    @classmethod
    def fit(cls, rows: Sequence[Mapping[str, Any]], name: str) -> StepTime:
        """Fit the model to measured speeds, by least squares of the relative errors; no part is below zero.

        Args:
            rows: "worlds", "threads" and NAME_sps [control steps/s over all worlds] each. name: of the speed.
        """
        worlds = np.array([row["worlds"] for row in rows], float)
        threads = np.array([row["threads"] for row in rows], float)
        times = worlds / np.array([row[f"{name}_sps"] for row in rows], float)
        parts = np.stack([np.ones_like(worlds), worlds, worlds / threads], axis=1)
        # Divided by the times, as small and large numbers of worlds shall count alike.
        found, _ = nnls(parts / times[:, None], np.ones_like(times))
        fixed, serial, parallel = (float(value) for value in found)
        return cls(
            fixed, serial, parallel, float(np.abs(parts @ found / times - 1.0).max())
        )

    def speed(self, worlds: int, threads: int) -> float:
        """Control steps/s over all worlds."""
        return worlds / (self.fixed + worlds * (self.serial + self.parallel / threads))

    def as_json(self) -> dict[str, float]:
        """The parts [microseconds] and the error [fraction]."""
        parts = {
            name: 1e6 * getattr(self, name) for name in ("fixed", "serial", "parallel")
        }
        return {f"{name}_us": round(value, 2) for name, value in parts.items()} | {
            "error": round(self.error, 4)
        }


@dataclass(frozen=True)
class ScalingSpec:
    """Measure the engine and the environment with several numbers of worlds and threads.

    From the table follows how much of a step is serial, and what more cores would give. It takes minutes, on an idle
    machine.
    """

    worlds: tuple[int, ...] = (1, 4, 16, 64, 256)
    """Numbers of worlds that step in parallel."""
    threads: tuple[int, ...] = ()
    """Numbers of threads; 1, 2, 4, ... up to the number of cores if absent."""
    task: str = "tidy_house"
    """Task that sets homes and objects: set_table, tidy_house, prepare_groceries or one of a plugin."""
    rounds: int = 5
    """Pairs of blocks; the results are medians over them."""
    seed: int = 0
    """Seed of the episodes."""
    robot: str = DEFAULT_ROBOT
    """The robot (see: mjhab robots list)."""
    assets: str = "builtin"
    """Asset pack: builtin, or FOLDER, with FOLDER?articulate=NAME,NAME?stage=FILE.glb for options of ReplicaCAD."""
    json: bool = False
    """Print one line of JSON instead of tables."""


def measure_scaling(
    spec: ScalingSpec, on_row: Callable[[Mapping[str, Any]], object] = bool
) -> dict[str, Any]:
    """Measure engine and environment with every number of worlds and threads, and fit `StepTime` to both.

    Args:
        spec: the request; threads () stands for 1, 2, 4, ... up to the number of cores.
        on_row: called with every row once it is measured.

    Returns:
        "rows": `sim.measure_engine` of each combination; "models": `StepTime.as_json` of engine and env;
        "predicted": control steps/s with the largest number of worlds on PREDICTED_CORES, a prediction.
    """
    rows: list[dict[str, Any]] = []
    for threads in spec.threads or threads_of(cores()):
        for worlds in spec.worlds:
            steps = int(np.clip(WORLD_STEPS // worlds, SHORTEST_BLOCK, LONGEST_BLOCK))
            one = SimSpec(
                worlds=worlds,
                threads=threads,
                task=spec.task,
                steps=steps,
                rounds=spec.rounds,
                seed=spec.seed,
                assets=spec.assets,
                robot=spec.robot,
            )
            rows.append(measure_engine(one))
            on_row(rows[-1])
    asked = dataclasses.asdict(spec)
    # How results are printed is no part of what was asked.
    del asked["json"]
    models = {name: StepTime.fit(rows, name) for name in MEASURED}
    most = max(spec.worlds)
    predicted = [
        {"cores": count, "worlds": most}
        | {f"{name}_sps": round(models[name].speed(most, count), 1) for name in MEASURED}
        for count in PREDICTED_CORES
    ]
    return {
        "rows": rows,
        "models": {name: model.as_json() for name, model in models.items()},
        "predicted": predicted,
        "spec": asked,
    }


def threads_of(count: int) -> tuple[int, ...]:
    """1, 2, 4, ... up to ``count``, and ``count`` itself."""
    powers = [1 << power for power in range(count.bit_length()) if 1 << power < count]
    return (*powers, count)


def bench_scaling(spec: ScalingSpec) -> int:
    """Print the results of `measure_scaling`.

    Raises:
        UsageError: there are too many combinations, or none.
    """
    if not spec.worlds:
        raise UsageError(
            "--worlds: give at least one number of worlds, for instance --worlds 1 16 256."
        )
    cells = len(spec.worlds) * len(spec.threads or threads_of(cores()))
    if cells > MAX_CELLS:
        raise UsageError(
            f"{cells} combinations of --worlds and --threads; at most {MAX_CELLS}."
        )
    found = measure_scaling(spec, _print_progress)
    names = ("threads", "worlds", "engine_sps", "env_sps", "ratio")
    report(
        spec.json,
        found,
        Listing(
            f"{spec.task}, {spec.robot}, control steps/s over all worlds",
            ("threads", "worlds", "engine", "environment", "environment / engine"),
            [[row[name] for name in names] for row in found["rows"]],
        ),
        Listing(
            "Time of a vector step [microseconds]: fixed + worlds x (serial + parallel / threads)",
            ("what", "fixed", "serial", "parallel", "largest error"),
            [(name, *found["models"][name].values()) for name in MEASURED],
        ),
        Listing(
            "Predicted from it, not measured: control steps/s",
            ("cores", "worlds", "engine", "environment"),
            [tuple(row.values()) for row in found["predicted"]],
        ),
    )
    return 0


def _print_progress(row: Mapping[str, Any]) -> None:
    print(
        f"mjhab: {row['threads']} threads, {row['worlds']} worlds: engine {row['engine_sps']:,.0f}, "
        f"environment {row['env_sps']:,.0f} control steps/s",
        file=sys.stderr,
    )


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(
        "scaling",
        ScalingSpec,
        bench_scaling,
        words,
        dict.fromkeys(("worlds", "threads", "rounds"), 1),
    )


if __name__ == "__main__":
    sys.exit(main())
