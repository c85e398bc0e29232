"""Is a data set whole? And if it is not: save what can be saved."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.locking import WriteLock, is_written
from mjhab.data.store.journal import committed_length, journal_path, recover
from mjhab.data.store.reading import open_shard, shard_paths
from mjhab.data.store.schema import DamagedError
from mjhab.data.store.shard import ShardWriter, StorageError, is_full
from mjhab.data.store.wreck import Wreck


@dataclass
class CheckReport:
    """What was found. ``damaged``: what is wrong, by shard and episode; ``unreadable``: by shard.

    ``schemas``: number of whole episodes by the version of the schema that they were recorded in.
    ``unfinished``: shards whose writer was killed in the middle of an episode; they are whole, and the next writer or
    ``repair`` puts them in order. ``doubled``: episodes that are in more than one place.
    """

    episodes: int = 0
    ok: int = 0
    damaged: dict[tuple[Path, str], list[str]] = field(default_factory=dict)
    unreadable: dict[Path, str] = field(default_factory=dict)
    unfinished: list[Path] = field(default_factory=list)
    doubled: list[str] = field(default_factory=list)
    schemas: Counter[int] = field(default_factory=Counter)

    @property
    def clean(self) -> bool:
        """Nothing is damaged, unreadable or doubled."""
        return not (self.damaged or self.unreadable or self.doubled)


@dataclass(frozen=True)
class Repair:
    """What became of one shard: episodes kept and lost; ``kept_as``: where the damaged file was put, if it was.

    ``indexed``: whether the index of episodes could be read. Without it, ``lost`` names only the episodes of which some
    part is still there.
    """

    path: Path
    finished: bool
    kept: int
    lost: dict[str, list[str]]
    kept_as: Path | None
    indexed: bool = True


def check(
    places: Path | Sequence[Path], on_shard: Callable[[], object] | None = None
) -> CheckReport:
    """Read every byte of every episode and compare it with its digest and with the schema.

    Raises:
        UsageError: nothing there, or a shard of another schema version.
    """
    report = CheckReport()
    seen: Counter[str] = Counter()
    for path in shard_paths(places):
        if journal_path(path).exists() and not is_written(path):
            report.unfinished.append(path)
        try:
            with open_shard(path) as shard:
                for name in shard.names:
                    report.episodes += 1
                    seen[name] += 1
                    wrong = shard.problems(name)
                    if wrong:
                        report.damaged[path, name] = wrong
                    else:
                        report.schemas[shard.episode(name).schema] += 1
        except DamagedError as error:
            report.unreadable[path] = str(error)
        if on_shard is not None:
            on_shard()
    report.ok = report.episodes - len(report.damaged)
    report.doubled = sorted(name for name, times in seen.items() if times > 1)
    return report


def repair(path: Path) -> Repair:
    """Put one shard in order: finish what a killed writer left, and drop episodes that are damaged.

    Every episode whose bytes are all there is kept, also when the file is cut or its index is damaged (see `wreck`).
    If episodes are dropped, the damaged file is kept beside the new one, with ".damaged" behind its name.

    Raises:
        UsageError: it is being written, or of another schema version.
        DamagedError: not one episode can be read; the file stays as it is.
        StorageError: the disk is full.
    """
    if not path.is_file():
        raise UsageError(f"{path} does not exist or is no file; give a shard (*.h5).")
    lock = WriteLock(path)
    try:
        pending = journal_path(path).exists()
        committed_length(path)
        cut = _is_cut(path)
        if not cut:
            recover(path)
            whole = _count_if_whole(path)
            if whole is not None:
                return Repair(path, pending, whole, {}, None)
        return _salvage(path, cut)
    except OSError as error:
        what = "the disk is full" if is_full(error) else error.strerror or str(error)
        raise StorageError(f"cannot repair {path}: {what}. The file was left as it is.") from error
    finally:
        lock.release()


def _count_if_whole(path: Path) -> int | None:
    """Number of episodes of a shard with which nothing is wrong; None if something is."""
    try:
        with open_shard(path) as shard:
            return None if any(shard.problems(name) for name in shard.names) else len(shard)
    except DamagedError:
        return None


def _is_cut(path: Path) -> bool:
    return path.stat().st_size < committed_length(path)


def _salvage(path: Path, cut: bool) -> Repair:
    aside = _free_name(path)
    source = path
    if cut:
        # HDF5 refuses a file that is shorter than it says: a copy is filled up with zeros, which no digest fits.
        source = path.with_name(f".{path.name}.padded")
        shutil.copyfile(path, source)
        os.truncate(source, committed_length(path))
    nothing = DamagedError(f"no episode in {path} can be read; the file was left as it is.")
    try:
        try:
            shard = Wreck(source)
        except DamagedError as error:
            if not cut:
                raise
            raise nothing from error
        with shard:
            found = {name: shard.problems(name) for name in shard.names}
            names = [name for name, wrong in found.items() if not wrong]
            if not names:
                raise nothing

            def fill(temporary: Path) -> None:
                with ShardWriter(temporary) as writer:
                    writer.adopt(shard, names)
                # The damaged file keeps a name of its own before the new one takes its place.
                os.link(path, aside)

            write_atomic(path, fill)
    finally:
        if cut:
            source.unlink(missing_ok=True)
    journal_path(path).unlink(missing_ok=True)
    lost = {name: wrong for name, wrong in found.items() if wrong}
    return Repair(path, False, len(names), lost, aside, shard.indexed)


def _free_name(path: Path) -> Path:
    number = 0
    name = path.with_name(path.name + ".damaged")
    while name.exists():
        number += 1
        name = path.with_name(f"{path.name}.damaged{number}")
    return name
