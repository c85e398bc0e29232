"""``mjhab bench env``: how fast an environment is, and where its time goes."""

from __future__ import annotations

import gc
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from mjhab.bench.environments.speed import measure_sps, sway
from mjhab.bench.environments.stages import (
    Stopwatch,
    stage_seconds,
    watch_env,
)
from mjhab.bench.specs import EnvBenchSpec
from mjhab.core.machine import resident_mb
from mjhab.sim.backends import check_device, resolve

if TYPE_CHECKING:
    from mjhab.envs.loop import TaskLoop
    from mjhab.envs.sequential import SequentialTaskEnv


def measure(spec: EnvBenchSpec) -> dict[str, Any]:
    """Measure every number of worlds, see `measure_env` and, for backend warp, `device_env.measure_device_env`.

    Returns:
        The fastest point, "backend", and all "points".

    Raises:
        UsageError: no such backend, or it has no such device.
    """
    backend = resolve(spec.asked.backend)
    check_device(backend, spec.asked.device)
    if backend == "warp":
        from mjhab.bench.environments.device_env import measure_device_env as work
    else:
        work = measure_env
    points = []
    for worlds in spec.worlds:
        points.append(work(spec, worlds))
        gc.collect()  # the worlds of this point make room for the next
    best = max(points, key=lambda point: point["env_sps"])
    return best | {"backend": backend, "profile": spec.asked.profile, "points": points}


def measure_env(spec: EnvBenchSpec, worlds: int) -> dict[str, Any]:
    """Build an environment, time it against its engine, and split the time of its steps into stages.

    Returns:
        ``env_sps``, ``engine_sps`` [control steps/s over all worlds, no resets in between], ``ratio``; ``stages``:
        seconds per stage over ``profiled_steps`` steps, with one reset of every world in ``reset``; ``reset_ms`` per
        world; ``rss_mb`` of the process at the end, ``world_mb`` what a world added; ``cold_start_s``: from nothing
        imported to the first observation of a step, compiled homes and kernels in the cache.
    """
    begun = time.perf_counter()
    from mjhab.envs import make_by_id

    # Here the backend is settled: "auto" would look for a GPU again.
    options = {**spec.env, "backend": "cpu", "device": ""}
    seed = spec.asked.seed
    env = make_by_id(spec.id, num_envs=worlds, autoreset="disabled", **options)
    env.reset(seed=seed)
    actions = sway(worlds, spec.steps, seed, len(env.action_table))
    env.step(actions[0])
    cold = time.perf_counter() - begun
    sps = measure_sps(env, spec.steps, spec.rounds, seed)
    stages, reset_ms = profile(env, actions)
    # Before the second simulator, which takes memory of its own.
    full = resident_mb()
    return {
        "env_sps": sps["env_sps"],
        "engine_sps": sps["engine_sps"],
        "ratio": sps["ratio"],
        "worlds": worlds,
        "stages": stages,
        "profiled_steps": len(actions),
        "reset_ms": reset_ms,
        "rss_mb": full,
        "world_mb": world_mb(env),
        "cold_start_s": round(cold, 2),
    }


def profile(env: TaskLoop, actions: np.ndarray) -> tuple[dict[str, float], float]:
    """Seconds per stage over the steps under ``actions`` (T, W, A) and one reset, and a world's reset [ms]."""
    watch = Stopwatch()
    watch_env(watch, env)
    begun = time.perf_counter()
    env.reset()
    for action in actions:
        env.step(action)
    return stage_seconds(watch, time.perf_counter() - begun, env.num_envs)


def world_mb(env: SequentialTaskEnv) -> float:
    """What one more world takes [MB], from a second simulator of 64 worlds of the same layout."""
    from mjhab.sim.mujoco.cpu import CpuSimulator

    before = resident_mb()
    more = CpuSimulator(env.layout, 64, env.sim.num_threads)
    more.reset(range(64), [env.homes[0]] * 64, np.repeat(env.sim.qpos[:1], 64, axis=0))
    # Resident memory counts only pages that were written, so the worlds must run once.
    more.step(np.zeros((64, env.ctrl.shape[1])))
    return round((resident_mb() - before) / 64, 2)
