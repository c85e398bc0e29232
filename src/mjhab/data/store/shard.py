"""Recording into one file: every finished episode is on the disk at once, the file is made of them at the end."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

from mjhab.core.errors import UsageError, fault
from mjhab.core.files.locking import WriteLock
from mjhab.data.store.episode_data import EpisodeData, RunInfo
from mjhab.data.store.episode_files import EpisodeFiles, part_folder
from mjhab.data.store.hdf5 import drop_unfinished
from mjhab.data.store.older.journal import finish_change
from mjhab.data.store.reading import open_shard
from mjhab.data.store.storage import broken, not_written
from mjhab.data.store.writing import write_shard
from mjhab.rollout.records import EpisodeRecord


class ShardWriter:
    """A shard that is recorded; ``append`` returns when the episode is on the disk. A context manager.

    ``names`` are those of its episodes. Until it is closed, new episodes are files in ``<shard>.part``, which all
    commands read as part of the shard. If the process is killed they stay, and the next writer, or `mjhab data repair`,
    takes them into the shard.

    Raises:
        UsageError: another process is writing the shard, or its schema version is not supported.
        DamagedError: the file is not a shard or cannot be read.
        StorageError: the disk is full or broken.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock: WriteLock | None = None
        self._stored: list[str] = []
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # Before anything is read: another writer may be about to replace the file.
            self._lock = WriteLock(path)
            if path.exists():
                # Opening refuses a file with a journal of mjhab 0.1.
                finish_change(path)
                with open_shard(path) as shard:
                    self._stored = shard.names
            self._parts = EpisodeFiles(part_folder(path))
            self.names = self._parts.names.union(self._stored)
        except OSError as error:
            self._release()
            raise not_written(path, error) from error
        except BaseException:
            self._release()
            raise

    def has(self, run: RunInfo, seed: int, index: int) -> bool:
        """Whether the shard has an episode already, so that a resumed run skips it."""
        return run.episode_name(seed, index) in self.names

    def append(self, data: EpisodeData) -> int:
        """Add an episode; returns its size [bytes].

        Raises:
            UsageError: the shard has the episode already.
            StorageError: the disk is full or broken; those before are safe. Make a new writer to continue.
        """
        if self._lock is None:
            raise fault(self.path, "has been closed; open it again to write")
        # Renaming over the first one would replace it without a word.
        if data.name in self.names:
            raise UsageError(
                f"episode {data.record.index} of seed {data.record.seed} is in {self.path} already; nothing was written"
            )
        try:
            size = self._parts.append(data)
        except OSError as error:
            # The disk is full: what is there stays, and a later call continues it.
            self._release()
            raise not_written(self.path, error) from error
        self.names.add(data.name)
        return size

    def close(self) -> None:
        """Make the file of all episodes, and let others write; may be called repeatedly.

        Raises:
            StorageError: the disk is full or broken; the episodes stay where they are.
        """
        if self._lock is None:
            return
        try:
            self._join()
        except OSError as error:
            raise not_written(self.path, error) from error
        finally:
            self._release()

    def _join(self) -> None:
        # Safe, because this process holds the lock.
        drop_unfinished(self.path.parent, self.path.stem)
        stored = set(self._stored)
        # A writer that was killed after it had made the file has left the parts.
        parts = {
            path: [name]
            for name, path in self._parts.paths().items()
            if name not in stored
        }
        if parts or not self.path.exists():
            present = {self.path: self._stored} if self._stored else {}
            write_shard(self.path, {**present, **parts})
        # Last: until the shard is whole, the parts are the only copy.
        shutil.rmtree(self._parts.folder, ignore_errors=True)

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def rewrite(path: Path, records: Mapping[str, EpisodeRecord]) -> None:
    """Replace the records of episodes of a file, by name (for relabelling).

    Raises:
        UsageError: another process is writing the file.
        StorageError: the disk is full or broken; nothing has changed.
    """
    try:
        with WriteLock(path):
            finish_change(path)
            with open_shard(path) as shard:
                names = shard.names
            write_shard(path, {path: names}, records)
    except OSError as error:
        raise broken(path, error) from error
