"""``mjhab episodes``: generate and check files of episodes in the HAB format."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mjhab.cli.output import Listing, report
from mjhab.cli.streams import with_way_on
from mjhab.config.env_spec import EnvSpec, env_options
from mjhab.core.errors import MjhabError, fault, wrong_value
from mjhab.core.files.reading import read_json_object
from mjhab.core.machine import cores
from mjhab.core.names import kind_of
from mjhab.core.progress import work_bar
from mjhab.core.typed.bounds import Bound, Output
from mjhab.core.typed.flags import Flag
from mjhab.tasks.household.registry import TASKS

if TYPE_CHECKING:
    from mjhab.episodes.hab.format import HabFile
    from mjhab.episodes.hab.reader import FileEpisodes

SUFFIXES = (".json", ".json.gz")
DISK_ADVICE = "Free some space, then the same command continues."


@dataclass(frozen=True, kw_only=True)
class EpisodesMakeSpec(EnvSpec):
    """Generate episodes and write them in the HAB format, with a manifest beside the file.

    `mjhab episodes make --task tidy_house --split val --count 100 --out episodes/tidy.json.gz`

    Every episode comes to rest in simulation before it is written, and depends on (task, split, seed, index) only.
    Ctrl-C keeps finished episodes; the same command continues.

    Raises:
        UsageError: an option is invalid.
    """

    out: Annotated[Path, Flag(metavar="FILE.json.gz"), Output()]
    """The file to write; gzip when it ends with .gz."""
    count: Annotated[
        int | None,
        Flag(shown="default: 10000 of train, 1000 of val and test"),
        Bound(1),
    ] = None
    """Number of episodes."""
    first: int = 0
    """Index of the first episode; every episode can be made without the others."""
    workers: Annotated[int, Bound(most=256)] = 0
    """Number of processes; 0 takes all cores. Changes the speed, never the episodes."""
    overwrite: bool = False
    """Replace the file and the unfinished files of an interrupted run with other options."""
    env: Annotated[
        Mapping[str, Any],
        env_options("task", "split", "seed", "assets", task="tidy_house"),
    ] = field(default_factory=dict)
    """Which episodes: fields of `EnvConfig`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.out.name.endswith(SUFFIXES):
            raise wrong_value(
                "out", str(self.out), "a name that ends with .json or .json.gz"
            )
        # Asked for here, so that a wrong option is told before any work.
        _ = self.asked


@dataclass(frozen=True)
class EpisodesCheckSpec(EnvSpec):
    """Load a file of episodes, simulate each for 2 s and report objects that do not stay where the file puts them.

    `mjhab episodes check tidy_house.json.gz --assets data`
    """

    file: Annotated[Path, Flag(metavar="FILE", positional=True)]
    """The file: *.json or *.json.gz in the HAB format."""
    env: Annotated[
        Mapping[str, Any],
        env_options(
            "assets",
            "task",
            "threads",
            docs={"task": "Task of the episodes."},
            shown={"task": "default: that in the file, or in its name"},
        ),
    ] = field(default_factory=dict)
    """Options of the environment, fields of `EnvConfig`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.asked


def make(spec: EpisodesMakeSpec, json: bool) -> int:
    """Write a file of generated episodes."""
    from mjhab.episodes.files import COUNTS, Recipe, make_file, manifest_path
    from mjhab.scenes.pack_source import pack_request

    asked = spec.asked
    count = COUNTS[asked.split] if spec.count is None else spec.count
    assets = pack_request(asked.assets).as_json()
    recipe = Recipe(asked.task, asked.split, asked.seed, assets, spec.first, count)
    started = time.perf_counter()
    with work_bar() as bar, with_way_on(DISK_ADVICE):
        line = bar.add_task(
            f"{asked.task} {asked.split}", total=count, note="", visible=False
        )

        def tell(done: int, rejected: int) -> None:
            bar.update(
                line, visible=True, completed=done, note=f"{rejected} draws rejected"
            )

        made = make_file(recipe, spec.out, spec.workers or cores(), tell, spec.overwrite)
    seconds = round(time.perf_counter() - started, 2)
    report(
        json,
        {**made, "seconds": seconds},
        f"{made['episodes']} episodes in {spec.out}, {made['rejected']} draws rejected, {seconds:.0f} s",
        f"manifest: {manifest_path(spec.out)}",
    )
    return 0


def check(spec: EpisodesCheckSpec, json: bool) -> int:
    """Load and simulate the episodes of a file, and print which objects do not stay in place."""
    from mjhab.episodes.hab.format import read_hab

    file = read_hab(spec.file)
    # Before the episodes are loaded, which takes longer and fails in stranger ways if they were changed.
    check_manifest(file)
    episodes = _load(spec, file)
    total = Counter[str]()
    fallen = Counter[str]()
    worst: dict[str, float] = {}
    with work_bar() as bar, ThreadPoolExecutor(spec.asked.threads or cores()) as pool:
        line = bar.add_task("settling", total=len(episodes), note="")
        for _, rest in pool.map(episodes.settled, range(len(episodes))):
            total.update(kind_of(name) for name in rest.names)
            fallen.update(kind_of(name) for name in rest.fallen)
            for name, moved in zip(rest.names, rest.moved.tolist(), strict=True):
                kind = kind_of(name)
                worst[kind] = max(worst.get(kind, 0.0), moved)
            bar.advance(line)
    share = 1.0 - fallen.total() / max(total.total(), 1)
    facts = {
        "episodes": len(file.episodes),
        "loaded": len(episodes),
        "at_rest": round(share, 4),
        "moved": {kind: fallen[kind] for kind in sorted(fallen)},
    }
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
    report(
        json,
        facts,
        Listing(f"{len(episodes)} episodes, 2 s of simulation each", columns, rows),
        f"{100 * share:.1f} % of {total.total()} objects stay where the file puts them",
    )
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
        raise fault(beside, f"not a manifest of episodes ({error}).") from error
    found = [state_hash(episode) for episode in file.episodes]
    if found != listed:
        k = next(
            (i for i, (a, b) in enumerate(zip(found, listed, strict=False)) if a != b),
            min(len(found), len(listed)),
        )
        raise MjhabError(
            f"{file.path}: episodes[{k}] differs from {beside.name}; make the file again."
        )


def _load(spec: EpisodesCheckSpec, file: HabFile) -> FileEpisodes:
    from mjhab.episodes.hab.reader import FileEpisodes, file_roster
    from mjhab.layout.layout import Layout
    from mjhab.scenes.packs import open_pack
    from mjhab.sim.mujoco.cpu import CpuSimulator

    pack = open_pack(spec.asked.assets)
    layout = Layout(pack, file_roster(file, pack))
    task = spec.env.get("task") or task_of(file)
    return FileEpisodes(CpuSimulator(layout, 1, 1), file, task)


def task_of(file: HabFile) -> str:
    """Task of a file: from its first episode, else from the file name, else tidy_house."""
    task: Any = file.episodes[0].info.get("task")
    if task in TASKS:
        return str(task)
    return next((task for task in TASKS if task in file.path.name), "tidy_house")
