"""Speed of the physics engine and of an environment: ``python -m benchmarks.sim --worlds 16``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.command import run_command
from mjhab.bench.environments.speed import measure_sps
from mjhab.cli.output import Listing, report
from mjhab.core.machine import cores
from mjhab.robots.registry import DEFAULT_ROBOT
from mjhab.tasks.household.registry import TASKS


@dataclass(frozen=True)
class SimSpec:
    """Measure control steps per second: the bare engine, and the whole environment without cameras."""

    worlds: int = 16
    """Number of worlds that step in parallel."""
    threads: int = 0
    """Threads of the physics; 0 takes all cores."""
    task: str = "tidy_house"
    """Task that sets homes and objects: set_table, tidy_house, prepare_groceries or one of a plugin."""
    steps: int = 40
    """Control steps per block; blocks of engine and environment alternate."""
    rounds: int = 9
    """Pairs of blocks; the results are medians over them."""
    seed: int = 0
    """Seed of the episodes."""
    robot: str = DEFAULT_ROBOT
    """The robot (see: mjhab robots list)."""
    assets: str = "builtin"
    """Asset pack: builtin, or FOLDER, with FOLDER?articulate=NAME,NAME?stage=FILE.glb for options of ReplicaCAD."""
    json: bool = False
    """Print one line of JSON instead of a table."""


def measure_engine(spec: SimSpec) -> dict[str, Any]:
    """Control steps/s of the engine and of the environment, measured in the same run: `measure_sps`, and "threads".

    Raises:
        UsageError: unknown task or robot.
    """
    TASKS.check(spec.task)
    from mjhab.envs import make

    env = make(
        robot=spec.robot,
        task=spec.task,
        num_envs=spec.worlds,
        assets=spec.assets,
        seed=spec.seed,
        threads=spec.threads,
        autoreset="disabled",
    )
    found = measure_sps(env, spec.steps, spec.rounds, spec.seed)
    return found | {"threads": spec.threads or cores()}


def bench_sim(spec: SimSpec) -> int:
    """Print control steps/s of the engine and of the environment, measured in the same run."""
    result = measure_engine(spec)
    rows = [
        ("bare engine", result["engine_sps"]),
        ("env.step without cameras", result["env_sps"]),
    ]
    title = (
        f"{spec.task}, {spec.robot}, {spec.worlds} worlds, {result['threads']} threads"
    )
    report(
        spec.json,
        result,
        Listing(title, ("what", "control steps/s over all worlds"), rows),
        f"the environment runs at {100 * result['ratio']:.0f} % of the bare engine; "
        f"resetting a world takes {result['reset_ms']:.1f} ms",
    )
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    minima: dict[str, float] = dict.fromkeys(("worlds", "steps", "rounds"), 1)
    return run_command("sim", SimSpec, bench_sim, words, minima)


if __name__ == "__main__":
    sys.exit(main())
