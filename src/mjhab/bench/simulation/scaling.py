"""``mjhab bench scaling``: speed over numbers of worlds and threads, and what follows from it for more cores."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import nnls

from mjhab.bench.simulation.engine import measure_engine
from mjhab.bench.specs import EngineSpec, ScalingSpec
from mjhab.core.machine import cores

WORLD_STEPS = 4000
LONGEST_BLOCK = 200
SHORTEST_BLOCK = 10
"""Control steps of a block: about WORLD_STEPS over all worlds, within these limits."""
PREDICTED_CORES = (4, 8, 16, 32, 64)
MOST_CELLS = 100
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


def measure_scaling(
    spec: ScalingSpec, tell: Callable[[Mapping[str, Any]], object] = bool
) -> dict[str, Any]:
    """Measure engine and environment with every number of worlds and threads, and fit `StepTime` to both.

    Args:
        spec: the request; threads () stands for 1, 2, 4, ... up to the number of cores.
        tell: called with every row once it is measured.

    Returns:
        "rows": `engine.measure_engine` of each combination; "models": `StepTime.as_json` of engine and env;
        "predicted": control steps/s with the largest number of worlds on PREDICTED_CORES, a prediction.
    """
    rows: list[dict[str, Any]] = []
    for threads in spec.threads or threads_of(cores()):
        for worlds in spec.worlds:
            steps = int(np.clip(WORLD_STEPS // worlds, SHORTEST_BLOCK, LONGEST_BLOCK))
            one = EngineSpec(
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
            tell(rows[-1])
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
        "spec": dataclasses.asdict(spec),
    }


def threads_of(count: int) -> tuple[int, ...]:
    """1, 2, 4, ... up to ``count``, and ``count`` itself."""
    powers = [1 << power for power in range(count.bit_length()) if 1 << power < count]
    return (*powers, count)
