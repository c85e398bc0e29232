"""Speed of computing starts: ``python -m benchmarks.spawn --subtask pick``."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.command import run_command
from benchmarks.profile_choice import ProfileChoice, resolved_profile
from mjhab.cli.output import Listing, report
from mjhab.core.machine import cores
from mjhab.robots.registry import DEFAULT_ROBOT


@dataclass(frozen=True)
class SpawnSpec(ProfileChoice):
    """Measure how many starts are computed per second, and how long settling a new object arrangement takes."""

    task: str = "tidy_house"
    """Which task: set_table, tidy_house, prepare_groceries or one of a plugin."""
    subtask: str = "pick"
    """Which subtask: pick, place, navigate, open, close or one of a plugin."""
    target: str = ""
    """The object or link to act on. All of them if absent."""
    count: int = 400
    """Number of measured starts."""
    pool: int = 16
    """Number of object arrangements that the starts share; all are loaded once before the measurement."""
    fresh: int = 4
    """Number of new arrangements to time."""
    threads: int = 1
    """Threads; 0 takes all cores. One is fastest if the simulation takes a small part of the time."""
    seed: int = 0
    """Seed of the episodes."""
    assets: str = "builtin"
    """Asset pack: builtin, or FOLDER, with FOLDER?articulate=NAME,NAME?stage=FILE.glb for options of ReplicaCAD."""
    json: bool = False
    """Print one line of JSON instead of a table."""


def bench_spawn(spec: SpawnSpec) -> int:
    """Print the results of `measure_spawns`."""
    found = measure_spawns(spec)
    rows = [
        ("starts per second", found["spawns_per_s"]),
        ("tries per start", found["tries_mean"]),
        ("fallbacks", found["fallbacks"]),
        ("settling a new arrangement of objects [s]", found["episode_s"]),
    ]
    title = (
        f"{spec.task} {spec.subtask}, {found['count']} starts, {found['threads']} threads"
    )
    report(spec.json, found, Listing(title, ("what", "value"), rows))
    return 0


def measure_spawns(spec: SpawnSpec) -> dict[str, Any]:
    """Time the computation of starts in cached object arrangements and, separately, of new arrangements.

    Returns:
        ``spawns_per_s``, ``tries_mean``, ``fallbacks``, ``count``, ``threads``; ``episode_s``: time on one core for one
        object arrangement that is not cached [s].
    """
    from mjhab.episodes.spawn_factory import SpawnFactory
    from mjhab.episodes.spawn_sets import SpawnRecipe

    resolved = resolved_profile(spec, task=spec.task, subtask=spec.subtask)
    recipe = SpawnRecipe(
        spec.task,
        spec.subtask,
        spec.target,
        "train",
        spec.seed,
        spec.count,
        spec.assets,
        pool=spec.pool,
        spawn_rule=resolved["spawn_rule"],
        robot=spec.robot or DEFAULT_ROBOT,
        joint_dynamics=resolved["joint_dynamics"],
    )
    factory = SpawnFactory(recipe)
    threads = spec.threads or cores()
    # Index count + i is another start in the same arrangement: this caches homes, maps and grasps before the timing.
    warm = [factory.episode(spec.count + i) for i in range(max(spec.pool, 2 * threads))]
    factory.starts.starts(warm, threads)
    episodes = [factory.episode(i) for i in range(spec.count)]
    begun = time.perf_counter()
    starts = factory.starts.starts(episodes, threads)
    seconds = time.perf_counter() - begun
    begun = time.perf_counter()
    for index in range(spec.fresh):
        factory.episodes.make(spec.seed, index)
    episode_s = (time.perf_counter() - begun) / spec.fresh
    return {
        "spawns_per_s": round(spec.count / seconds, 1),
        "tries_mean": round(sum(start.tries for start in starts) / len(starts), 3),
        "fallbacks": sum(start.fallback for start in starts),
        "episode_s": round(episode_s, 3),
        "count": spec.count,
        "threads": threads,
    }


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    minima: dict[str, float] = dict.fromkeys(("count", "pool", "fresh"), 1)
    return run_command("spawn", SpawnSpec, bench_spawn, words, minima)


if __name__ == "__main__":
    sys.exit(main())
