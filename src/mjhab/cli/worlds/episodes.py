"""``mjhab episodes``: generate and check files of episodes in the HAB format."""

from __future__ import annotations

import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from mjhab.cli.options.episodes import EpisodesCheckOptions, EpisodesMakeOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.cli.streams import with_way_on
from mjhab.core.errors import MjhabError, UsageError, unknown_name
from mjhab.core.files.reading import read_json_object
from mjhab.core.machine import cores
from mjhab.core.names import kind_of
from mjhab.tasks.household.registry import TASKS

if TYPE_CHECKING:
    from mjhab.episodes.hab.format import HabFile
    from mjhab.episodes.hab.reader import FileEpisodes

SPLITS = ("train", "val", "test")
SUFFIXES = (".json", ".json.gz")
DISK_ADVICE = "Free some space, then the same command continues."


def run_episodes(options: EpisodesMakeOptions | EpisodesCheckOptions) -> int:
    """Run one of the two commands and return the exit code."""
    if isinstance(options, EpisodesMakeOptions):
        return make(options)
    return check(options)


def make(options: EpisodesMakeOptions) -> int:
    """Write a file of generated episodes."""
    TASKS.check(options.task)
    if options.split not in SPLITS:
        raise unknown_name("split", options.split, SPLITS)
    at_least("first", options.first, 0)
    at_least("seed", options.seed, 0)
    at_least("workers", options.workers, 0)
    if options.count is not None:
        at_least("count", options.count, 1)
    if not options.out.name.endswith(SUFFIXES):
        raise UsageError(f"--out must end with .json or .json.gz, got {options.out}.")
    from mjhab.episodes.files import COUNTS, Recipe, make_file, manifest_path

    count = COUNTS[options.split] if options.count is None else options.count
    recipe = Recipe(
        options.task, options.split, options.seed, options.assets, options.first, count
    )
    started = time.perf_counter()
    with _bar() as bar, with_way_on(DISK_ADVICE):
        line = bar.add_task(
            f"{options.task} {options.split}", total=count, note="", visible=False
        )

        def tell(done: int, rejected: int) -> None:
            bar.update(
                line, visible=True, completed=done, note=f"{rejected} draws rejected"
            )

        made = make_file(
            recipe, options.out, options.workers or cores(), tell, options.overwrite
        )
    seconds = round(time.perf_counter() - started, 2)
    if options.json:
        print_json({**made, "seconds": seconds})
    else:
        print(
            f"{made['episodes']} episodes in {options.out}, {made['rejected']} draws rejected, {seconds:.0f} s"
        )
        print(f"manifest: {manifest_path(options.out)}")
    return 0


def check(options: EpisodesCheckOptions) -> int:
    """Load and simulate the episodes of a file, and print which objects do not stay in place."""
    at_least("threads", options.threads, 0)
    if options.task is not None:
        TASKS.check(options.task)
    from mjhab.episodes.hab.format import read_hab

    file = read_hab(options.file)
    check_manifest(file)
    episodes = _load(options, file)
    total = Counter[str]()
    fallen = Counter[str]()
    worst: dict[str, float] = {}
    with _bar() as bar, ThreadPoolExecutor(options.threads or cores()) as pool:
        line = bar.add_task("settling", total=len(episodes), note="")
        for _, rest in pool.map(episodes.settled, range(len(episodes))):
            total.update(kind_of(name) for name in rest.names)
            fallen.update(kind_of(name) for name in rest.fallen)
            for name, moved in zip(rest.names, rest.moved.tolist(), strict=True):
                kind = kind_of(name)
                worst[kind] = max(worst.get(kind, 0.0), moved)
            bar.advance(line)
    share = 1.0 - fallen.total() / max(total.total(), 1)
    if options.json:
        moved = {kind: fallen[kind] for kind in sorted(fallen)}
        print_json(
            {
                "episodes": len(file.episodes),
                "loaded": len(episodes),
                "at_rest": round(share, 4),
                "moved": moved,
            }
        )
        return 0
    columns = (
        "object",
        "copies",
        "moved > 2 cm or tipped > 10 deg",
        "share [%]",
        "farthest [mm]",
    )
    rows = [
        (
            kind,
            total[kind],
            fallen[kind],
            round(100 * fallen[kind] / total[kind], 1),
            round(1000 * worst[kind], 1),
        )
        for kind in sorted(total)
    ]
    print_table(f"{len(episodes)} episodes, 2 s of simulation each", columns, rows)
    print(f"{100 * share:.1f} % of {total.total()} objects stay where the file puts them")
    return 0


def check_manifest(file: HabFile) -> None:
    """Compare a file with the manifest beside it, if there is one.

    Raises:
        MjhabError: an episode is not the one that the manifest lists.
    """
    from mjhab.episodes.files import manifest_path, state_hash

    beside = manifest_path(file.path)
    if not beside.is_file():
        return
    try:
        listed = [row["hash"] for row in read_json_object(beside)["episodes"]]
    except (KeyError, TypeError) as error:
        raise UsageError(f"{beside}: not a manifest of episodes ({error}).") from error
    found = [state_hash(episode) for episode in file.episodes]
    if found != listed:
        k = next(
            (i for i, (a, b) in enumerate(zip(found, listed, strict=False)) if a != b),
            min(len(found), len(listed)),
        )
        raise MjhabError(
            f"{file.path}: episodes[{k}] differs from {beside.name}; make the file again."
        )


def _load(options: EpisodesCheckOptions, file: HabFile) -> FileEpisodes:
    from mjhab.episodes.hab.reader import FileEpisodes, file_roster
    from mjhab.layout.layout import Layout
    from mjhab.scenes.packs import open_pack
    from mjhab.sim.mujoco.cpu import CpuSimulator

    pack = open_pack(options.assets)
    layout = Layout(pack, file_roster(file, pack))
    return FileEpisodes(CpuSimulator(layout, 1, 1), file, options.task or task_of(file))


def task_of(file: HabFile) -> str:
    """Task of a file: from its first episode, else from the file name, else tidy_house."""
    told: Any = file.episodes[0].info.get("task")
    if told in TASKS:
        return str(told)
    return next((task for task in TASKS if task in file.path.name), "tidy_house")


def _bar() -> Progress:
    return Progress(
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=Console(stderr=True),
    )
