"""Checking data sets for damage, and repairing shards."""

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
from mjhab.data.store.damage import problems_in
from mjhab.data.store.journal import committed_length, journal_path, recover
from mjhab.data.store.places import shard_paths
from mjhab.data.store.reading import open_shard
from mjhab.data.store.schema import DamagedError
from mjhab.data.store.shard import ShardWriter, StorageError, is_full
from mjhab.data.store.wreck import Wreck


@dataclass
class CheckReport:
    """Result of a check.

    episodes, ok: numbers of all and of undamaged episodes. damaged: problems by shard and episode. unreadable: errors
    by shard. unfinished: shards whose writer was killed within an episode; they are not damaged, and the next writer or
    ``repair`` completes them. doubled: episodes that occur more than once. schemas: number of undamaged episodes by
    schema version.
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
        """Whether nothing is damaged, unreadable or duplicated."""
        return not (self.damaged or self.unreadable or self.doubled)


@dataclass(frozen=True)
class Repair:
    """Result of a repair.

    finished: an interrupted commit was completed or undone. kept: number of kept episodes. lost: problems by name of
    the lost episodes. kept_as: new path of the damaged file, if it was replaced. indexed: the index of episodes could
    be read; otherwise ``lost`` names only episodes of which a part still exists.
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
    """Read every episode completely and compare it with its digest and with the schema.

    Raises:
        UsageError: there is no shard, or one has an unsupported schema version.
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
                    wrong = problems_in(shard, name)
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
    """Repair one shard: complete an interrupted write, and drop damaged episodes.

    Every intact episode is kept, even if the file is truncated or its index is damaged (see `wreck`). If episodes are
    dropped, the damaged file is kept with ".damaged" appended to its name.

    Raises:
        UsageError: another process writes the shard, or its schema version is not supported.
        DamagedError: no episode can be read; the file stays unchanged.
        StorageError: the disk is full.
    """
    if not path.is_file():
        raise UsageError(f"{path} does not exist or is no file; give a shard (*.h5).")
    with WriteLock(path):
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
            raise StorageError(
                f"cannot repair {path}: {what}. The file was left as it is."
            ) from error


def _count_if_whole(path: Path) -> int | None:
    """Number of episodes of an undamaged shard; None if it is damaged."""
    try:
        with open_shard(path) as shard:
            return (
                None
                if any(problems_in(shard, name) for name in shard.names)
                else len(shard)
            )
    except DamagedError:
        return None


def _is_cut(path: Path) -> bool:
    return path.stat().st_size < committed_length(path)


def _salvage(path: Path, cut: bool) -> Repair:
    aside = _free_name(path)
    source = path
    if cut:
        # HDF5 refuses a truncated file, so a copy is padded with zeros; digests will not match there.
        source = path.with_name(f".{path.name}.padded")
        shutil.copyfile(path, source)
        os.truncate(source, committed_length(path))
    nothing = DamagedError(
        f"no episode in {path} can be read; the file was left as it is."
    )
    try:
        try:
            shard = Wreck(source)
        except DamagedError as error:
            if not cut:
                raise
            raise nothing from error
        with shard:
            found = {name: problems_in(shard, name) for name in shard.names}
            names = [name for name, wrong in found.items() if not wrong]
            if not names:
                raise nothing

            def fill(temporary: Path) -> None:
                with ShardWriter(temporary) as writer:
                    writer.adopt(shard, names)
                # The damaged file gets another name before the new one replaces it.
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
