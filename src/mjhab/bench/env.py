"""``mjhab bench env``: how fast an environment is, and where its time goes."""

from __future__ import annotations

import gc
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from mjhab.bench.engine import measure_sps, sway
from mjhab.bench.stages import STAGES, Stopwatch, resident_mb, stage_seconds, watch_env
from mjhab.cli.options.env import BenchEnvOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.cli.profiles import profile_options
from mjhab.sim.backends import resolve

if TYPE_CHECKING:
    from mjhab.envs.loop import TaskLoop
    from mjhab.envs.sequential import SequentialTaskEnv


def bench_env(options: BenchEnvOptions) -> int:
    """Print what `measure` finds."""
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


def measure(options: BenchEnvOptions) -> dict[str, Any]:
    """Measure every number of worlds, see `measure_env` and, for backend warp, `device_env.measure_device_env`.

    Returns:
        The fastest point, "backend", and all "points".
    """
    backend = resolve(options.backend)
    if backend == "warp":
        from mjhab.bench.device_env import measure_device_env as work
    else:
        work = measure_env
    points = []
    for worlds in options.worlds:
        points.append(work(options, worlds))
        gc.collect()  # the worlds of this point make room for the next
    best = max(points, key=lambda point: point["env_sps"])
    return best | {"backend": backend, "profile": options.profile, "points": points}


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
    rows = [(told, point[name]) for name, told in names.items() if point.get(name) is not None]
    print_table(
        f"{options.env}, {options.obs}, {point['worlds']} worlds, {backend}",
        ("what", "value"),
        rows,
    )
    steps = point["profiled_steps"]
    stages = [(stage, round(1000 * point["stages"][stage] / steps, 3)) for stage in STAGES]
    print_table("where the time of a step of all worlds goes", ("stage", "ms"), stages)


def measure_env(options: BenchEnvOptions, worlds: int) -> dict[str, Any]:
    """Build an environment, time it against its engine, and split the time of its steps into stages.

    Returns:
        ``env_sps``, ``engine_sps`` [control steps/s over all worlds, no resets in between], ``ratio``; ``stages``:
        seconds per stage over ``profiled_steps`` steps, with one reset of every world in ``reset``; ``reset_ms`` per
        world; ``rss_mb`` of the process at the end, ``world_mb`` what a world added; ``cold_start_s``: from nothing
        imported to the first observation of a step, compiled homes and kernels in the cache.
    """
    begun = time.perf_counter()
    from mjhab.envs import make_by_id

    extra = {"reward_mode": options.reward, "task": options.task}
    env = make_by_id(
        options.env,
        num_envs=worlds,
        obs_mode=options.obs,
        camera_size=options.camera_size,
        assets=options.assets,
        seed=options.seed,
        threads=options.threads,
        autoreset="disabled",
        **{k: v for k, v in extra.items() if v is not None},
        **profile_options(options),
    )
    env.reset(seed=options.seed)
    actions = sway(worlds, options.steps, options.seed, len(env.action_table))
    env.step(actions[0])
    cold = time.perf_counter() - begun
    sps = measure_sps(env, options.steps, options.rounds, options.seed)
    stages, reset_ms = profile(env, actions)
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
    more.step(np.zeros((64, env.ctrl.shape[1])))
    return round((resident_mb() - before) / 64, 2)
