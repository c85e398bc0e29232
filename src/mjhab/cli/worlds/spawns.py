"""``mjhab spawns``: compute and list sets of starts; ``mjhab bench spawn``: speed of computing starts."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from mjhab.cli.options.spawn import (
    BenchSpawnOptions,
    SpawnsListOptions,
    SpawnsMakeOptions,
)
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.config.profile_choice import resolved_profile
from mjhab.core.errors import UsageError
from mjhab.core.machine import cores
from mjhab.core.progress import progress_bar
from mjhab.robots.registry import DEFAULT_ROBOT


def run_spawns(options: SpawnsMakeOptions | SpawnsListOptions) -> int:
    """Run one of the two commands and return the exit code."""
    if isinstance(options, SpawnsMakeOptions):
        return make(options)
    return listing(options)


def make(options: SpawnsMakeOptions) -> int:
    """Write a set of starts."""
    at_least("count", options.count, 1)
    for name in ("pool", "seed", "threads"):
        at_least(name, getattr(options, name), 0)
    from mjhab.episodes.spawn_factory import make_set
    from mjhab.episodes.spawn_sets import SpawnRecipe

    resolved = resolved_profile(options, task=options.task, subtask=options.subtask or "")
    recipe = SpawnRecipe(
        options.task,
        options.subtask or "",
        options.target or "",
        options.split,
        options.seed,
        options.count,
        options.assets,
        options.home or "",
        options.pool,
        options.harvested,
        resolved["spawn_rule"],
        options.robot or DEFAULT_ROBOT,
        resolved["joint_dynamics"],
    )
    begun = time.perf_counter()
    shown = 0
    with progress_bar(
        f"{options.task} {options.subtask or 'chain'}", options.count
    ) as advance:

        def tell(done: int, fallbacks: int) -> None:
            nonlocal shown
            for _ in range(done - shown):
                advance()
            shown = done

        made = make_set(
            recipe, options.out, options.threads or cores(), tell, options.overwrite
        ).describe()
    seconds = round(time.perf_counter() - begun, 2)
    if options.json:
        print_json({**made, "seconds": seconds})
    else:
        print(
            f"{made['count']} starts in {made['homes']} homes in {options.out}, {made['fallbacks']} of them fallbacks, "
            f"{seconds:.0f} s; layout {made['layout']}, digest {made['digest']}"
        )
    return 0


def listing(options: SpawnsListOptions) -> int:
    """Print a table of the sets at a path."""
    from mjhab.episodes.spawn_sets import SUFFIX, SpawnSet

    path = options.path
    if not path.exists():
        raise UsageError(
            f"{path} does not exist; `mjhab spawns make --out FILE{SUFFIX}` makes a set."
        )
    files = sorted(path.glob(f"[!.]*{SUFFIX}")) if path.is_dir() else [path]
    found = []
    damaged = []
    for file in files:
        try:
            found.append(SpawnSet.read(file).describe())
        except UsageError as error:
            if not path.is_dir():
                raise
            damaged.append(str(error))
    if options.json:
        print_json({"sets": found, "unreadable": damaged})
        return 0
    columns = (
        "file",
        "robot",
        "task",
        "subtask",
        "target",
        "split",
        "spawn_rule",
        "joint_dynamics",
        "seed",
        "count",
        "homes",
        "fallbacks",
        "pack",
        "layout",
    )
    rows = [
        [
            Path(one["file"]).name
            if name == "file"
            else one[name] or ("all" if name == "target" else one[name])
            for name in columns
        ]
        for one in found
    ]
    print_table(f"{len(found)} sets of starts in {path}", columns, rows)
    for line in damaged:
        print(line)
    return 0


def bench_spawn(options: BenchSpawnOptions) -> int:
    """Print the results of `measure_spawns`."""
    for name in ("count", "pool", "fresh"):
        at_least(name, getattr(options, name), 1)
    for name in ("threads", "seed"):
        at_least(name, getattr(options, name), 0)
    found = measure_spawns(options)
    if options.json:
        print_json(found)
        return 0
    rows = [
        ("starts per second", found["spawns_per_s"]),
        ("tries per start", found["tries_mean"]),
        ("fallbacks", found["fallbacks"]),
        ("settling a new arrangement of objects [s]", found["episode_s"]),
    ]
    title = f"{options.task} {options.subtask}, {found['count']} starts, {found['threads']} threads"
    print_table(title, ("what", "value"), rows)
    return 0


def measure_spawns(options: BenchSpawnOptions) -> dict[str, Any]:
    """Time the computation of starts in cached object arrangements and, separately, of new arrangements.

    Returns:
        ``spawns_per_s``, ``tries_mean``, ``fallbacks``, ``count``, ``threads``; ``episode_s``: time on one core for one
        object arrangement that is not cached [s].
    """
    from mjhab.episodes.spawn_factory import SpawnFactory
    from mjhab.episodes.spawn_sets import SpawnRecipe

    resolved = resolved_profile(options, task=options.task, subtask=options.subtask)
    recipe = SpawnRecipe(
        options.task,
        options.subtask,
        options.target or "",
        "train",
        options.seed,
        options.count,
        options.assets,
        pool=options.pool,
        spawn_rule=resolved["spawn_rule"],
        robot=options.robot or DEFAULT_ROBOT,
        joint_dynamics=resolved["joint_dynamics"],
    )
    factory = SpawnFactory(recipe)
    threads = options.threads or cores()
    # Index count + i is another start in the same arrangement: this caches homes, maps and grasps before the timing.
    warm = [
        factory.episode(options.count + i) for i in range(max(options.pool, 2 * threads))
    ]
    factory.starts.starts(warm, threads)
    episodes = [factory.episode(i) for i in range(options.count)]
    begun = time.perf_counter()
    starts = factory.starts.starts(episodes, threads)
    seconds = time.perf_counter() - begun
    begun = time.perf_counter()
    for index in range(options.fresh):
        factory.episodes.make(options.seed, index)
    episode_s = (time.perf_counter() - begun) / options.fresh
    return {
        "spawns_per_s": round(options.count / seconds, 1),
        "tries_mean": round(sum(start.tries for start in starts) / len(starts), 3),
        "fallbacks": sum(start.fallback for start in starts),
        "episode_s": round(episode_s, 3),
        "count": options.count,
        "threads": threads,
    }
