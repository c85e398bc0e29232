"""Folders in which every finished episode is a file, and a table of them; episodes lie here until they are packed.

<episode>.h5    one episode, as in a shard; its name is the episode's identity, so that no two writers take the same
index.jsonl     the table: a line per episode (and one per run) with what filters and statistics ask for

The files are the truth. The table saves opening them: a line counts as long as size and time of change of its file are
those in the line; other files are opened, and the table is written anew. So it may be deleted, and a line that a killed
writer left torn does no harm. Lines of JSON, not parquet: a writer adds one with a single write, and reading 1,000 of
them takes 0.1 s, without a library that only the extra ``data`` installs.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjhab.core.files.cache import write_atomic
from mjhab.core.files.locking import WriteLock
from mjhab.data.store.episode_data import (
    EpisodeData,
    RunInfo,
    from_bytes,
    record_problems,
    to_bytes,
)
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.data.store.schema import DamagedError
from mjhab.data.store.writing import write_episode
from mjhab.rollout.records import EpisodeRecord

EPISODE_FOLDER = "episodes"
"""Folder of episode files in that of a data set."""
INDEX = "index.jsonl"
GENERATION_CONFIG = "generation.json"
"""Configuration of a generated data set; its lock is that of the folder."""
_NAME = re.compile(r"[0-9a-f]{8}-\d+-\d{7,}")
"""Name of an episode: hash of its config, seed, index (`RunInfo.episode_name`)."""


@dataclass(frozen=True)
class EpisodeEntry:
    """What filters and statistics ask of an episode. path: of its file. digest: of its content."""

    path: Path
    name: str
    record: EpisodeRecord
    run: RunInfo
    digest: str

    @classmethod
    def of(cls, episode: RecordedEpisode) -> EpisodeEntry:
        """The entry of an episode that is read.

        Raises:
            DamagedError: it cannot be read.
        """
        digest = str(episode.attributes["digest"])
        path = episode.shard.path
        return cls(path, episode.name, episode.record, episode.run, digest)


def is_episode_file(path: Path) -> bool:
    """Whether a file is named as one of a single episode."""
    return _NAME.fullmatch(path.stem) is not None


def part_folder(shard: Path) -> Path:
    """Folder of the episode files of a shard that is being recorded."""
    return shard.with_name(f"{shard.name}.part")


def lock_set(folder: Path) -> WriteLock:
    """Lock a folder whose EPISODE_FOLDER is being filled or packed.

    Raises:
        UsageError: another process is doing that.
    """
    return WriteLock(folder / GENERATION_CONFIG, folder)


class EpisodeFiles:
    """The episode files in a folder, which need not exist yet; several processes may write different episodes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names = set(self.paths())
        self._known_runs: set[str] = set()

    def paths(self) -> dict[str, Path]:
        """The files that are there now, by name of the episode."""
        # Asked anew every time, because other processes write here.
        found = self.folder.glob("*.h5") if self.folder.is_dir() else ()
        return {path.stem: path for path in sorted(found) if is_episode_file(path)}

    def path_of(self, name: str) -> Path:
        """Where the file of an episode lies."""
        return self.folder / f"{name}.h5"

    def append(self, data: EpisodeData) -> int:
        """Write an episode; returns its size [bytes].

        Raises:
            OSError: the disk is full or broken; those before are safe.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.path_of(data.name)
        # The file before its line: a line without a file would name an episode that is not there.
        digest = write_episode(path, data)
        entry = EpisodeEntry(path, data.name, data.record, data.run, digest)
        lines = [_line(entry)]
        if data.run.id not in self._known_runs:
            # Before the line that refers to it, as the table is read from the top.
            lines.insert(0, _run_line(data.run))
        _add(self.folder / INDEX, lines)
        self._known_runs.add(data.run.id)
        self.names.add(data.name)
        return path.stat().st_size


def entries_of(folder: Path, paths: Sequence[Path]) -> Iterator[EpisodeEntry]:
    """Entries of episode files in one folder: of the table as far as it knows them, and of the files themselves.

    Raises:
        DamagedError: a file cannot be read.
    """
    known = _read_table(folder)
    is_whole = True
    for path in paths:
        entry = known.get(path.name)
        # Copied files, and those whose line was lost by a kill, are read and entered.
        if entry is None:
            is_whole = False
            entry = known[path.name] = _read_entry(path)
        yield entry
    if not is_whole:
        _write_table(folder / INDEX, list(known.values()))


def _read_entry(path: Path) -> EpisodeEntry:
    with open_shard(path) as shard:
        if shard.names != [path.stem]:
            raise DamagedError(
                f"{path} is named as the file of one episode, and holds {shard.names[:3] or 'none'}."
            )
        return EpisodeEntry.of(shard.episode(path.stem))


def _read_table(folder: Path) -> dict[str, EpisodeEntry]:
    """The entries whose files are as they were when the line was written, by name of the file."""
    try:
        lines = (folder / INDEX).read_bytes().splitlines()
    # The table is only a shortcut: without it every file is read.
    except OSError:
        return {}
    runs: dict[str, RunInfo] = {}
    found: dict[str, EpisodeEntry] = {}
    for line in lines:
        with contextlib.suppress(
            ValueError, KeyError, TypeError, AttributeError, OSError
        ):
            entry = from_bytes(line)
            if "about" in entry:
                runs[entry["run"]] = RunInfo.from_dict(entry["about"])
                continue
            path = folder / f"{entry['name']}.h5"
            record = EpisodeRecord.from_dict(entry["record"])
            # A file that was changed or copied since is read again.
            if entry["file"] == _stamp(path) and not record_problems(record):
                found[path.name] = EpisodeEntry(
                    path, path.stem, record, runs[entry["run"]], str(entry["digest"])
                )
    return found


def _write_table(path: Path, entries: Sequence[EpisodeEntry]) -> None:
    runs = {entry.run.id: entry.run for entry in entries}
    lines = [*map(_run_line, runs.values()), *map(_line, entries)]
    # Who may only read goes on without.
    with contextlib.suppress(OSError):
        write_atomic(path, lambda temporary: temporary.write_bytes(b"".join(lines)))


def _add(path: Path, lines: Sequence[bytes]) -> None:
    with contextlib.suppress(OSError):
        # Appended by one write, so that lines of several processes do not mix.
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        try:
            os.write(fd, b"".join(lines))
        finally:
            os.close(fd)


def _run_line(run: RunInfo) -> bytes:
    return _encoded({"run": run.id, "about": vars(run)})


def _line(entry: EpisodeEntry) -> bytes:
    line = {
        "name": entry.name,
        "file": _stamp(entry.path),
        "digest": entry.digest,
        "run": entry.run.id,
        "record": {**entry.record.to_dict(), "seconds": 0.0},
    }
    return _encoded(line)


def _encoded(value: Any) -> bytes:
    return to_bytes(value).tobytes() + b"\n"


def _stamp(path: Path) -> list[int]:
    """Size [bytes] and time of the last change [ns] of a file."""
    stat = path.stat()
    return [stat.st_size, stat.st_mtime_ns]
