"""Speed of an environment and of its bare physics engine, in control steps per second."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from mjhab.rollout.policy import ACTION_SIZE

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv

WARM_STEPS = 8
"""Control steps after each reset that are not timed: teleports take place and objects come to rest."""


def measure_sps(
    env: SequentialTaskEnv, steps: int, rounds: int, seed: int
) -> dict[str, Any]:
    """Time ``env.step`` and the bare engine on the same physics: same starts, same commands, moving robots.

    Every round takes ``num_envs`` fresh episodes. The environment runs them once untimed, which records the actuator
    commands; then the environment and the engine under those commands run them again, timed, in turn.

    Args:
        env: env with autoreset disabled, ``ctrl`` (the last commands) and a simulator with ``bare_step(ctrl)``.
        steps: control steps per block.
        rounds: rounds; the medians of their times count.
        seed: seed of the episodes and of the motions.

    Returns:
        ``engine_sps``, ``env_sps`` [control steps/s over all worlds], ``ratio`` = env / engine, ``worlds``,
        ``reset_ms``: time of one world's reset [ms] to an episode whose arrangement is in the cache.
    """
    worlds = env.num_envs
    width = len(env.action_table)
    times: dict[str, list[float]] = {"engine": [], "env": [], "reset": []}
    for number in range(rounds):
        actions = sway(worlds, steps, seed + number, width)
        episodes = np.arange(number * worlds, (number + 1) * worlds)

        # A default binds the episodes of this round.
        def begin(episodes: np.ndarray = episodes) -> float:
            """Start the episodes; seconds that the reset takes."""
            options = {"episode": episodes, "reset_mask": np.ones(worlds, bool)}
            started = time.perf_counter()
            env.reset(seed=seed, options=options)
            seconds = time.perf_counter() - started
            for _ in range(WARM_STEPS):
                env.step(np.zeros((worlds, width), np.float32))
            return seconds

        begin()
        commands = []
        for action in actions:
            env.step(action)
            commands.append(env.ctrl)
        # In turns, because the second of a pair finds warmer caches and a hotter processor.
        for name in ("engine", "env") if number % 2 else ("env", "engine"):
            times["reset"].append(begin())
            call, inputs = (
                (env.step, actions) if name == "env" else (env.sim.bare_step, commands)
            )
            times[name].append(_seconds(call, inputs))
    # The median, as other processes can delay single blocks.
    engine, whole = (worlds * steps / median(times[name]) for name in ("engine", "env"))
    return {
        "engine_sps": round(engine, 1),
        "env_sps": round(whole, 1),
        "ratio": round(whole / engine, 4),
        "worlds": worlds,
        "reset_ms": round(1000 * median(times["reset"]) / worlds, 3),
    }


def sway(worlds: int, steps: int, seed: int, size: int = ACTION_SIZE) -> np.ndarray:
    """Smooth motions (steps, W, size) of all joints and the base, each dimension with its own period."""
    rng = np.random.default_rng(seed)
    period = rng.uniform(20, 60, (worlds, size))
    phase = rng.uniform(0, 2 * np.pi, (worlds, size))
    time_axis = np.arange(steps)[:, None, None]
    return (0.5 * np.sin(2 * np.pi * time_axis / period + phase)).astype(np.float32)


def _seconds(call: Callable[[Any], object], inputs: Iterable[Any]) -> float:
    start = time.perf_counter()
    for item in inputs:
        call(item)
    return time.perf_counter() - start
