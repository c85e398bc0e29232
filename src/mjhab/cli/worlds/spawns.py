"""``mjhab spawns``: compute and list sets of starts."""

from __future__ import annotations

import time
from pathlib import Path

from mjhab.cli.options.spawn import SpawnsListOptions, SpawnsMakeOptions
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
