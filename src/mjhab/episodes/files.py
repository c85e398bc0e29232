"""Make files of episodes in the HAB format with several processes; an interrupted run is resumed."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mjhab.core.errors import fault
from mjhab.core.files.cache import write_text
from mjhab.core.files.outputs import naming_file
from mjhab.core.files.reading import parse_json
from mjhab.episodes.generator import EpisodeMaker
from mjhab.episodes.hab.format import HabEpisode, to_json, write_rows
from mjhab.episodes.hab.writer import to_hab
from mjhab.episodes.rosters import roster
from mjhab.layout.layout import Layout
from mjhab.scenes.packs import open_pack, stage_of
from mjhab.sim.mujoco.cpu import CpuSimulator

FORMAT = "mjhab-episodes-1"
COUNTS = {"train": 10_000, "val": 1_000, "test": 1_000}
"""Episodes per task by split, as in MS-HAB."""
_STATE_FIELDS = ("scene_id", "rigid_objs", "ao_states", "targets")
_CHUNK = 4
"""Episodes that a worker process makes per job."""


@dataclass(frozen=True)
class Recipe:
    """Content of a file: episodes ``first`` to ``first + count - 1`` of (task, split, seed) in an asset pack."""

    task: str
    split: str
    seed: int
    assets: str | dict[str, Any]
    first: int
    count: int


@dataclass(frozen=True)
class FinishedEpisode:
    """One finished episode.

    Attributes:
        index: index of the episode.
        home: name of its home.
        rejected: draws rejected before it, because objects did not come to rest.
        digest: `state_hash` of the episode.
        text: the episode as JSON text.
    """

    index: int
    home: str
    rejected: int
    digest: str
    text: str


def state_hash(episode: HabEpisode) -> str:
    """Return the hash of scene, object poses, joint positions and goals of an episode, to compare machines."""
    row = to_json(episode)
    # Of the rounded numbers of the file, so that the last bits of the arithmetic do not count.
    stated = json.dumps({name: row[name] for name in _STATE_FIELDS}, sort_keys=True)
    return hashlib.sha256(stated.encode()).hexdigest()[:16]


def partial_path(out: Path) -> Path:
    """Return the path of the log of finished episodes, which exists until the file is complete."""
    return out.with_name(out.name + ".partial")


def manifest_path(out: Path) -> Path:
    """Return the path of a file's manifest, which lists its episodes; it is in the same folder."""
    return out.with_name(
        out.name.removesuffix(".gz").removesuffix(".json") + ".manifest.json"
    )


class Factory:
    """Makes the rows of a recipe in a simulator with one world.

    Args:
        recipe: content of the file.
    """

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        layout = Layout(open_pack(recipe.assets), roster(recipe.task))
        self.maker = EpisodeMaker(CpuSimulator(layout, 1, 1), recipe.task, recipe.split)
        self._homes = layout.pack.homes_by_name

    def row(self, index: int) -> FinishedEpisode:
        """Make one episode.

        Raises:
            UsageError: a home has no room for the objects.
        """
        episode, rejected = self.maker.make(self.recipe.seed, index)
        hab = to_hab(self.maker.layout, self._homes[episode.home], episode)
        return FinishedEpisode(
            index,
            episode.home,
            rejected,
            state_hash(hab),
            # NaN is no JSON: other readers of the format would refuse the whole file.
            json.dumps(to_json(hab), allow_nan=False),
        )


def make_file(
    recipe: Recipe,
    out: Path,
    workers: int,
    tell: Callable[[int, int], None],
    overwrite: bool = False,
) -> dict[str, int]:
    """Make the episodes of a recipe and write them to a file; an interrupted run of the same recipe is resumed.

    Args:
        recipe: content of the file.
        out: ``*.json`` or ``*.json.gz``; the manifest is written to the same folder.
        workers: number of processes; 1 uses the calling process.
        tell: called with the number of finished episodes and of rejected draws so far.
        overwrite: replace ``out``, and delete the partial file of an interrupted run of another recipe.

    Returns:
        Totals of the file: ``episodes``, and ``rejected`` (draws whose objects did not come to rest).

    Raises:
        UsageError: ``out`` exists, or there is a partial file of another recipe.
    """
    if out.exists() and not overwrite:
        raise fault(out, "exists; add --overwrite, or choose another --out.")
    factory = Factory(recipe)
    # The header is compared as a whole: a run is resumed only for the same recipe, assets and code.
    header = {"format": FORMAT, **asdict(recipe), "pack": factory.maker.digest}
    header |= stage_of(recipe.assets)
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_path(out)
    rows = _resume(partial, header, overwrite)
    done = len(rows)
    rejected = sum(row.rejected for row in rows)
    tell(done, rejected)
    missing = range(recipe.first + done, recipe.first + recipe.count)
    with naming_file(partial), partial.open("a", encoding="utf-8") as log:
        for row in _rows(factory, missing, workers):
            log.write(json.dumps(asdict(row)) + "\n")
            # Every finished episode counts after a crash, and making one takes far longer than writing it.
            log.flush()
            rows.append(row)
            done += 1
            rejected = rejected + row.rejected
            tell(done, rejected)
    write_rows(out, {"config": None}, (row.text for row in rows))
    # The log is deleted last: if writing fails, nothing made is lost.
    _write_manifest(out, header, rows)
    partial.unlink()
    return {"episodes": done, "rejected": rejected}


def _write_manifest(
    out: Path, header: dict[str, Any], rows: list[FinishedEpisode]
) -> None:
    listed = [
        {"index": r.index, "home": r.home, "rejected": r.rejected, "hash": r.digest}
        for r in rows
    ]
    text = json.dumps({**header, "episodes": listed}, indent=1)
    write_text(manifest_path(out), text)


def _resume(
    partial: Path, header: dict[str, Any], overwrite: bool
) -> list[FinishedEpisode]:
    """Return the rows that an interrupted run of this recipe wrote to ``partial``; creates the file if there is none.

    Raises:
        UsageError: ``partial`` is of another recipe, and ``overwrite`` is not set.
    """
    lines = partial.read_text(encoding="utf-8").splitlines() if partial.exists() else []
    rows: list[FinishedEpisode] = []
    if lines and _parsed(lines[0]) == header:
        for line in lines[1:]:
            found = _parsed(line)
            # The last line may be incomplete: rows before it are used.
            if found is None or found.get("index") != header["first"] + len(rows):
                break
            rows.append(FinishedEpisode(**found))
    elif lines and not overwrite:
        raise fault(
            partial,
            "was left by a run with other options, assets or code; finish that run, delete the file, or "
            "add --overwrite.",
        )
    # Written anew, so that what is appended does not follow a torn last line.
    kept = [json.dumps(header), *(json.dumps(asdict(row)) for row in rows)]
    write_text(partial, "\n".join(kept) + "\n")
    return rows


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        return parse_json(line)
    except ValueError:
        return None


def _rows(factory: Factory, indices: range, workers: int) -> Iterator[FinishedEpisode]:
    """Yield rows in the order of ``indices``; they do not depend on the number of workers."""
    # Starting processes takes longer than a few episodes do.
    if workers == 1 or len(indices) <= _CHUNK:
        yield from map(factory.row, indices)
        return
    # A forked process would share the locks and the threads of numba and MuJoCo.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, _start_worker, (factory.recipe,))
    try:
        yield from pool.map(_work, indices, chunksize=_CHUNK)
    finally:
        # Without this an interrupt would first finish everything that is queued.
        pool.shutdown(wait=True, cancel_futures=True)


_factories: list[Factory] = []
"""The `Factory` of a worker process, once `_start_worker` has run."""


def _start_worker(recipe: Recipe) -> None:
    # Ctrl-C is handled by the parent process, which keeps finished episodes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _factories.append(Factory(recipe))


def _work(index: int) -> FinishedEpisode:
    return _factories[0].row(index)
