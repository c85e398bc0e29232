"""Checking data sets for damage, and repairing shards."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mjhab.core.errors import fault
from mjhab.core.files.locking import WriteLock, is_written
from mjhab.data.store.damage import problems_in
from mjhab.data.store.episode_files import is_episode_file, part_folder
from mjhab.data.store.older.journal import finish_change, journal_path
from mjhab.data.store.places import is_leftover, shard_paths
from mjhab.data.store.reading import open_shard
from mjhab.data.store.schema import DamagedError
from mjhab.data.store.shard import ShardWriter
from mjhab.data.store.storage import StorageError, reason_of
from mjhab.data.store.writing import write_shard


@dataclass
class CheckReport:
    """Result of a check.

    episodes, ok: numbers of all and of undamaged episodes. damaged: problems by shard and episode. unreadable: errors
    by shard. unfinished: shards whose writer was killed; they are not damaged, and the next writer or ``repair``
    completes them. doubled: episodes that occur more than once. schemas: number of undamaged episodes by schema
    version.
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

    finished: what an interrupted writer had left was completed. kept: number of kept episodes. lost: problems by name
    of the lost episodes. kept_as: new path of the damaged file, if it was replaced.
    """

    path: Path
    finished: bool
    kept: int
    lost: dict[str, list[str]]
    kept_as: Path | None


def check(
    places: Path | Sequence[Path], on_shard: Callable[[], object] | None = None
) -> CheckReport:
    """Read every episode completely and compare it with its digest and with the schema.

    Raises:
        UsageError: there is no shard, or one has an unsupported schema version.
    """
    report = CheckReport()
    seen: dict[str, Path] = {}
    for path in shard_paths(places):
        if _is_unfinished(path):
            report.unfinished.append(path)
        try:
            with open_shard(path) as shard:
                for name in shard.names:
                    first = seen.setdefault(name, path)
                    # What a killed packing left is a copy, and no damage.
                    if first != path and is_leftover(path, first, name):
                        continue
                    report.episodes += 1
                    report.doubled += [] if first == path else [name]
                    wrong = problems_in(shard, name)
                    if wrong:
                        report.damaged[path, name] = wrong
                    else:
                        report.schemas[shard.episode(name).schema] += 1
        except DamagedError as error:
            report.unreadable[path] = str(error)
        if on_shard is not None:
            on_shard()
    # At the end, because an unreadable shard ends in the middle of its count.
    report.ok = report.episodes - len(report.damaged)
    report.doubled.sort()
    return report


def _is_unfinished(path: Path) -> bool:
    """Whether a shard has something beside it that a killed writer left."""
    left = journal_path(path).exists() or part_folder(path).is_dir()
    return left and not is_written(path)


def repair(path: Path) -> Repair:
    """Repair one file: complete an interrupted write, and drop damaged episodes.

    If episodes are dropped, the damaged file is kept with ".damaged" appended to its name.

    Raises:
        UsageError: another process writes the shard, or its schema version is not supported.
        DamagedError: no episode can be read; the file stays unchanged.
        StorageError: the disk is full.
    """
    if not path.is_file():
        raise fault(path, "does not exist or is no file; give a shard (*.h5).")
    pending = _is_unfinished(path)
    try:
        if pending:
            # Opening and closing does what the killed writer would have done.
            ShardWriter(path).close()
        with WriteLock(path):
            # A writer of mjhab 0.1 that was killed early has left bytes behind the end, and no journal.
            finish_change(path)
            with open_shard(path) as shard:
                found = {name: problems_in(shard, name) for name in shard.names}
            lost = {name: wrong for name, wrong in found.items() if wrong}
            kept = [name for name in found if name not in lost]
            if not lost:
                return Repair(path, pending, len(kept), {}, None)
            return Repair(path, pending, len(kept), lost, _without(path, kept))
    except OSError as error:
        raise StorageError(
            f"cannot repair {path}: {reason_of(error)}. The file was left as it is."
        ) from error


def _without(path: Path, kept: Sequence[str]) -> Path:
    """Replace a file by one of the episodes ``kept``; returns the new name of the damaged one."""
    # An empty shard would hide that there was data; a file of one episode has nothing else to keep.
    if not kept and not is_episode_file(path):
        raise DamagedError(
            f"no episode in {path} can be read; the file was left as it is."
        )
    aside = _free_name(path)
    # A second name and not a rename: a kill in between leaves the file in its place.
    os.link(path, aside)
    try:
        if kept:
            write_shard(path, {path: kept})
        else:
            path.unlink()
    except BaseException:
        # The file itself was not replaced, so that its second name is not needed.
        aside.unlink()
        raise
    return aside


def _free_name(path: Path) -> Path:
    number = 0
    name = path.with_name(path.name + ".damaged")
    while name.exists():
        number += 1
        name = path.with_name(f"{path.name}.damaged{number}")
    return name
