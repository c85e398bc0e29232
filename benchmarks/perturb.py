"""What perturbations cost: ``python -m benchmarks.perturb``."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.command import run_command
from mjhab.cli.output import Listing, report
from mjhab.config.perturbing import AXES
from mjhab.envs import make_train

CLEAN = ""


@dataclass(frozen=True)
class PerturbSpec:
    """Measure control steps of `make_train` environments with `randomise` of one axis each, beside one without.

    `python -m benchmarks.perturb --level 3 --obs rgbd`

    Times are CPU times of one thread, in turns, so that other work on the machine counts as little as may be.
    """

    axes: tuple[str, ...] = AXES
    """The axes."""
    level: int = 3
    """Their level; ``randomise`` draws one from 0 to it."""
    subtask: str = "close"
    """The subtask."""
    obs: str = "rgbd"
    """Observation mode."""
    size: int = 128
    """Side of the images [px]."""
    worlds: int = 8
    """Number of worlds."""
    steps: int = 10
    """Control steps of a turn."""
    turns: int = 5
    """Turns of every environment."""
    json: bool = False
    """Print one line of JSON instead of a table."""


def measure(spec: PerturbSpec) -> dict[str, Any]:
    """CPU time of a control step of all worlds [ms] by axis, and of one reset of a world; "clean" without any."""
    envs = {}
    resets = {}
    for axis in (CLEAN, *spec.axes):
        env = make_train(
            subtask=spec.subtask,
            obs_mode=spec.obs,
            camera_size=spec.size,
            num_envs=spec.worlds,
            threads=1,
            randomise=f"{axis}:{spec.level}" if axis else "",
        )
        env.reset(seed=0)
        begun = time.process_time()
        # The second reset counts, because the first compiles homes.
        env.reset(seed=1)
        resets[axis] = time.process_time() - begun
        envs[axis] = env
    seconds: dict[str, list[float]] = {axis: [] for axis in envs}
    random = np.random.default_rng(0)
    for turn in range(spec.turns + 1):
        actions = random.uniform(-1, 1, (spec.steps, *envs[CLEAN].action_space.shape))
        # In turns, so that a busier machine slows all of them.
        for axis, env in envs.items():
            # Rubbish of one environment must not be collected in the time of another.
            gc.collect()
            begun = time.process_time()
            for action in actions.astype(np.float32):
                env.step(action)
            # The first turn compiles and fills caches.
            seconds[axis] += [time.process_time() - begun] if turn else []
    rows = {
        axis or "clean": {
            "step_ms": round(1000.0 * float(np.median(found)) / spec.steps, 2),
            "reset_ms": round(1000.0 * resets[axis] / spec.worlds, 1),
        }
        for axis, found in seconds.items()
    }
    clean = rows["clean"]["step_ms"]
    for row in rows.values():
        row["slower"] = round(row["step_ms"] / clean - 1.0, 3)
    for env in envs.values():
        env.close()
    return {"worlds": spec.worlds, "size": spec.size, "obs": spec.obs, "axes": rows}


def run(spec: PerturbSpec) -> int:
    """Measure and print; returns 0."""
    found = measure(spec)
    rows = [
        (axis, row["step_ms"], f"{100 * row['slower']:+.1f} %", row["reset_ms"])
        for axis, row in found["axes"].items()
    ]
    columns = ("axis", "step [ms]", "slower by", "reset of a world [ms]")
    title = f"{spec.worlds} worlds, {spec.obs} {spec.size} px"
    report(spec.json, found, Listing(title, columns, rows))
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command line."""
    return run_command(
        "perturb", PerturbSpec, run, words, {"worlds": 1, "steps": 1, "turns": 1}
    )


if __name__ == "__main__":
    sys.exit(main())
