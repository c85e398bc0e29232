"""``mjhab bench env``: speed of an environment, and the time of its stages."""

from __future__ import annotations

from typing import Any

from mjhab.bench.environments.env import measure
from mjhab.bench.environments.stages import STEP_STAGES
from mjhab.bench.specs import EnvBenchSpec
from mjhab.cli.output import Listing, report


def bench_env(spec: EnvBenchSpec, json: bool) -> int:
    """Print the results of `measure`."""
    found = measure(spec)
    points = [_tables(spec, found["backend"], point) for point in found["points"]]
    report(json, found, *(table for tables in points for table in tables))
    return 0


def _tables(
    spec: EnvBenchSpec, backend: str, point: dict[str, Any]
) -> tuple[Listing, Listing]:
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
        (label, point[name])
        for name, label in names.items()
        if point.get(name) is not None
    ]
    title = f"{spec.id}, {spec.asked.obs_mode}, {point['worlds']} worlds, {backend}"
    steps = point["profiled_steps"]
    stages = [
        (stage, round(1000 * point["stages"][stage] / steps, 3)) for stage in STEP_STAGES
    ]
    return (
        Listing(title, ("what", "value"), rows),
        Listing("where the time of a step of all worlds goes", ("stage", "ms"), stages),
    )
