"""``mjhab bench``: how fast this machine is, and whether grasps hold."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from mjhab.cli.doctor import cores
from mjhab.cli.options.common import BenchGraspOptions, BenchSimOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.core.errors import unknown_name
from mjhab.rollout.policy import ACTION_SIZE
from mjhab.tasks.plan import TASKS

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv

WARM_STEPS = 8
"""Untimed control steps after each reset: teleports happen and things come to rest."""


def bench_sim(options: BenchSimOptions) -> int:
    """Print control steps/s of the engine and of the environment, measured in the same run."""
    if options.task not in TASKS:
        raise unknown_name("task", options.task, TASKS)
    for name in ("worlds", "steps", "rounds"):
        at_least(name, getattr(options, name), 1)
    at_least("threads", options.threads, 0)
    at_least("seed", options.seed, 0)
    from mjhab.envs import make

    env = make(
        task=options.task,
        num_envs=options.worlds,
        assets=options.assets,
        seed=options.seed,
        threads=options.threads,
        autoreset="disabled",
    )
    result = measure_sps(env, options.steps, options.rounds, options.seed)
    result["threads"] = options.threads or cores()
    if options.json:
        print_json(result)
    else:
        rows = [
            ("bare engine", result["engine_sps"]),
            ("env.step without cameras", result["env_sps"]),
        ]
        title = f"{options.task}, {options.worlds} worlds, {result['threads']} threads"
        print_table(title, ("what", "control steps/s over all worlds"), rows)
        print(f"the environment runs at {100 * result['ratio']:.0f} % of the bare engine")
    return 0


def measure_sps(env: SequentialTaskEnv, steps: int, rounds: int, seed: int) -> dict[str, Any]:
    """Time ``env.step`` and the bare engine on the same physics: same starts, same commands, moving robots.

    Every round takes ``num_envs`` fresh episodes. The environment runs them once untimed, which records the actuator
    commands; then the environment and the engine under those commands run them again, timed, in turn.

    Args:
        env: env with autoreset disabled, ``ctrl`` (the last commands) and a simulator with ``bare_step(ctrl)``.
        steps: control steps per block.
        rounds: rounds; the medians of their times count.
        seed: seed of the episodes and of the motions.

    Returns:
        ``engine_sps``, ``env_sps`` [control steps/s over all worlds], ``ratio`` = env / engine, ``worlds``.
    """
    worlds = env.num_envs
    times: dict[str, list[float]] = {"engine": [], "env": []}
    for number in range(rounds):
        actions = sway(worlds, steps, seed + number)
        episodes = np.arange(number * worlds, (number + 1) * worlds)

        def begin(episodes: np.ndarray = episodes) -> None:
            env.reset(seed=seed, options={"episode": episodes, "reset_mask": np.ones(worlds, bool)})
            for _ in range(WARM_STEPS):
                env.step(np.zeros((worlds, ACTION_SIZE), np.float32))

        begin()
        commands = []
        for action in actions:
            env.step(action)
            commands.append(env.ctrl)
        for name in ("engine", "env") if number % 2 else ("env", "engine"):
            begin()
            call, inputs = (env.step, actions) if name == "env" else (env.sim.bare_step, commands)
            times[name].append(_seconds(call, inputs))
    engine, whole = (worlds * steps / median(times[name]) for name in ("engine", "env"))
    return {
        "engine_sps": round(engine, 1),
        "env_sps": round(whole, 1),
        "ratio": round(whole / engine, 4),
        "worlds": worlds,
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


def bench_grasp(options: BenchGraspOptions) -> int:
    """Print how far objects slip in the moving gripper; fails if one is dropped."""
    at_least("seed", options.seed, 0)
    at_least("seconds", options.seconds, 0.1)
    from mjhab.bench.grasp import grasp_table

    rows = grasp_table(seconds=options.seconds, seed=options.seed)
    if options.json:
        print_json({"grasps": rows})
    else:
        columns = list(rows[0])
        print_table(
            f"{options.seconds:g} s of base and arm motion",
            columns,
            [[row[key] for key in columns] for row in rows],
        )
    return 1 if any(row["dropped"] for row in rows) else 0
