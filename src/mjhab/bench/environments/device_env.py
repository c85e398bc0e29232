"""``mjhab bench env --backend warp``: how fast an environment on a device is, and where its time goes."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import TYPE_CHECKING, Any

from mjhab.bench.environments.memory_sampler import MemorySampler, gpu_used_mb
from mjhab.bench.environments.speed import sway
from mjhab.bench.environments.stages import (
    Stopwatch,
    stage_seconds,
    watch_env,
)
from mjhab.bench.specs import EnvBenchSpec
from mjhab.core.machine import resident_mb

if TYPE_CHECKING:
    from mjhab.envs.device.env import DeviceEnv

WARM_STEPS = 3
"""Control steps that are not timed: kernels are loaded and CUDA graphs captured."""


def measure_device_env(spec: EnvBenchSpec, worlds: int) -> dict[str, Any]:
    """Measure a `DeviceEnv` as `env.measure_env` does an environment on the CPU; finished worlds reset within the step.

    Returns:
        ``env_sps``: control steps/s over all worlds, median of the rounds, with actions that are on the device;
        ``engine_sps``: of physics alone under the last commands; ``ratio``; ``stages``: seconds per stage over
        ``profiled_steps`` steps, each waited for, so that on a GPU they add up to more than the steps take;
        ``reset_ms`` per world; ``device_mb`` (None without a GPU) and ``rss_mb``: largest during the rounds;
        ``cold_start_s``: to the first observation of a step; ``tainted``: worlds.
    """
    begun = time.perf_counter()
    env, wait = _make(spec, worlds)
    seed = spec.asked.seed
    env.reset(seed=seed)
    given = sway(worlds, spec.steps, seed, len(env.action_table))
    actions = [env.sim.qpos.new_tensor(row) for row in given]
    env.step(actions[0])
    wait()
    cold = time.perf_counter() - begun
    for _ in range(WARM_STEPS):
        env.step(actions[0])

    def block() -> None:
        for action in actions:
            env.step(action)

    def engine() -> None:
        for _ in actions:
            env.sim.step(commands)

    with MemorySampler(resident_mb, lambda: gpu_used_mb(env.sim.device)) as memory:
        whole = _rate(block, spec, worlds, wait)
    stages, reset_ms = profile(env, actions, wait)
    # After the profile, so that the bare engine gets commands of a moving robot.
    commands = env.sim.engine.ctrl_t.clone()
    bare = _rate(engine, spec, worlds, wait)
    return {
        "env_sps": whole,
        "engine_sps": bare,
        "ratio": round(whole / bare, 4),
        "worlds": worlds,
        "stages": stages,
        "profiled_steps": len(actions),
        "reset_ms": reset_ms,
        "rss_mb": memory.peak_rss_mb,
        "device_mb": memory.peak_device_mb,
        "cold_start_s": round(cold, 2),
        "device": str(env.sim.device),
        "tainted": int((env.sim.taint() != 0).sum()),
    }


def _make(spec: EnvBenchSpec, worlds: int) -> tuple[DeviceEnv, Callable[[], None]]:
    """The environment, and what waits for its device."""
    from mjhab.envs import make_by_id
    from mjhab.sim.warp.probe import synchronize

    # Threads are of the host, and the backend is given here.
    apart = ("backend", "threads")
    options = {name: value for name, value in spec.env.items() if name not in apart}
    env = make_by_id(spec.id, backend="warp", num_envs=worlds, **options)
    return env, lambda: synchronize(env.sim.device)


def _rate(
    work: Callable[[], None], spec: EnvBenchSpec, worlds: int, wait: Callable[[], None]
) -> float:
    """Control steps/s over all worlds: the median of the rounds."""
    times = []
    for _ in range(spec.rounds):
        wait()
        begun = time.perf_counter()
        work()
        wait()
        times.append(time.perf_counter() - begun)
    return round(worlds * spec.steps / median(times), 1)


def profile(
    env: DeviceEnv, actions: list[Any], wait: Callable[[], None]
) -> tuple[dict[str, float], float]:
    """Seconds per stage over the steps under ``actions``, and one reset of every world, and a world's reset [ms]."""
    watch = Stopwatch(wait)
    watch_env(watch, env)
    wait()
    begun = time.perf_counter()
    env.reset()
    for action in actions:
        env.step(action)
    wait()
    return stage_seconds(watch, time.perf_counter() - begun, env.num_envs)
