"""``mjhab bench env``: speed of an environment, and the time of its stages."""

from __future__ import annotations

from typing import Any

from mjhab.bench.environments.env import measure
from mjhab.bench.environments.stages import STAGES
from mjhab.cli.options.env import BenchEnvOptions
from mjhab.cli.output import at_least, print_json, print_table


def bench_env(options: BenchEnvOptions) -> int:
    """Print the results of `measure`."""
    for name in ("steps", "rounds", "camera-size"):
        at_least(name, getattr(options, name.replace("-", "_")), 1)
    at_least("worlds", min(options.worlds, default=0), 1)
    at_least("threads", options.threads, 0)
    at_least("seed", options.seed, 0)
    found = measure(options)
    if options.json:
        print_json(found)
        return 0
    for point in found["points"]:
        _print(options, found["backend"], point)
    return 0


def _print(options: BenchEnvOptions, backend: str, point: dict[str, Any]) -> None:
    names = {
        "env_sps": "environment [control steps/s]",
        "engine_sps": "bare engine [control steps/s]",
        "ratio": "environment / engine",
        "reset_ms": "one reset [ms]",
        "rss_mb": "memory [MB]",
        "world_mb": "memory per world [MB]",
        "device_mb": "memory of the GPU [MB]",
        "cold_start_s": "cold start [s]",
        "tainted": "tainted worlds",
    }
    rows = [
        (told, point[name]) for name, told in names.items() if point.get(name) is not None
    ]
    print_table(
        f"{options.env}, {options.obs}, {point['worlds']} worlds, {backend}",
        ("what", "value"),
        rows,
    )
    steps = point["profiled_steps"]
    stages = [
        (stage, round(1000 * point["stages"][stage] / steps, 3)) for stage in STAGES
    ]
    print_table("where the time of a step of all worlds goes", ("stage", "ms"), stages)
