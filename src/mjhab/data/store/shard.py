"""Writing shards: HDF5 files of episodes that stay readable after a kill at any moment (see `journal`)."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np

from mjhab.core.errors import MjhabError, UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.locking import WriteLock
from mjhab.core.version import __version__
from mjhab.data.store.episode_data import (
    EpisodeData,
    RunInfo,
    episode_digest,
    last_label,
    record_bytes,
    style_text,
    to_bytes,
)
from mjhab.data.store.hdf5 import (
    change_file,
    check_format,
    group,
    make_file,
    put_attributes,
    read_arrays,
)
from mjhab.data.store.journal import recover, sync_folder
from mjhab.data.store.schema import COLUMNS, EPISODES, FORMAT, RUNS, VERSION
from mjhab.rollout.records import EpisodeRecord

if TYPE_CHECKING:
    from mjhab.data.store.reading import Shard

_GZIP = 4
_SMALL = 256
"""Arrays smaller than this are stored uncompressed in the header of their dataset [bytes]."""
_CHUNK = 4 << 20
"""Largest HDF5 chunk [bytes]."""
_BATCH = 32 << 20
"""Approximate size of a batch of episodes that is copied at once and held in memory [bytes]."""


class StorageError(MjhabError):
    """The disk is full or broken. Data written before are safe."""


class ShardWriter:
    """A shard open for writing; ``append`` returns when the episode is on the disk. A context manager.

    The shard is made if it does not exist. If its last writer was killed, the shard is recovered first, and
    ``recovered`` tells whether that writer's last episode was completed.

    Raises:
        UsageError: another process is writing the shard, or its schema version is not supported.
        DamagedError: the file is not a shard or cannot be read.
        StorageError: the disk is full or broken.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.recovered = False
        self._lock: WriteLock | None = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = WriteLock(path)
            self._open()
        except OSError as error:
            self.close()
            raise _storage_error(path, error) from error
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        if self.path.exists():
            self.recovered = recover(self.path)
        else:
            write_atomic(self.path, _make_empty)
            sync_folder(self.path)
        self._names: set[str] = set()
        self._runs: set[str] = set()
        with h5py.File(self.path, "r", locking=False) as file:
            self._schema = check_format(file, self.path)
            self._names.update(group(file, EPISODES))
            self._runs.update(group(file, RUNS))

    @property
    def names(self) -> frozenset[str]:
        """Names of the episodes in it."""
        return frozenset(self._names)

    def has(self, run: RunInfo, seed: int, index: int) -> bool:
        """Whether the shard has an episode already, so that a resumed run skips it."""
        return run.episode_name(seed, index) in self._names

    def append(self, data: EpisodeData) -> int:
        """Add an episode; returns by how many bytes the file has grown.

        Raises:
            UsageError: the shard has the episode already.
            StorageError: the disk is full or broken; the shard is unchanged. Make a new writer to continue.
        """
        if data.name in self._names:
            raise UsageError(
                f"episode {data.record.index} of seed {data.record.seed} is in {self.path} already; nothing was written"
            )

        def fill(file: h5py.File) -> None:
            if data.run.id not in self._runs:
                _put(group(file, RUNS), data.run.id, to_bytes(vars(data.run)))
            _put_episode(group(file, EPISODES).create_group(data.name), data)
            self._raise_schema(file)

        grown = self._change(fill)
        self._names.add(data.name)
        self._runs.add(data.run.id)
        return grown

    def replace_records(self, records: dict[str, EpisodeRecord]) -> None:
        """Replace the records of episodes, by name, atomically (for relabelling)."""

        def fill(file: h5py.File) -> None:
            for name, record in records.items():
                episode = group(file, f"{EPISODES}/{name}")
                del episode["record"]
                _put(episode, "record", record_bytes(record))
                digest = episode_digest(read_arrays(episode))
                put_attributes(episode, {"label": last_label(record), "digest": digest})

        self._change(fill)

    def adopt(self, shard: Shard, names: Sequence[str]) -> int:
        """Copy episodes of another shard unchanged; returns by how many bytes the file has grown.

        Raises:
            UsageError: this shard already has one of them.
            StorageError: the disk is full or broken; episodes copied before are safe.
        """
        taken = self._names.intersection(names)
        if taken:
            raise UsageError(
                f"episode {min(taken)} is in {self.path} already; nothing was written"
            )
        return sum(self._adopt(shard, batch) for batch in _batches(shard, names))

    def _adopt(self, shard: Shard, names: Sequence[str]) -> int:
        episodes = [shard.episode(name) for name in names]
        runs = {str(episode.attributes["run"]): episode.run_data for episode in episodes}

        def fill(file: h5py.File) -> None:
            for episode in episodes:
                episode.copy_to(group(file, EPISODES))
            for run in sorted(runs.keys() - self._runs):
                _put(group(file, RUNS), run, to_bytes(runs[run]))
            self._raise_schema(file)

        grown = self._change(fill)
        self._names.update(names)
        self._runs.update(runs)
        return grown

    def _raise_schema(self, file: h5py.File) -> None:
        """Mark a file of an older schema with the present version, and its existing episodes with their own version."""
        if self._schema < VERSION:
            put_attributes(file, {"schema": VERSION, "mjhab": __version__})
            self._schema = VERSION

    def _change(self, fill: Callable[[h5py.File], None]) -> int:
        if self._lock is None:
            raise UsageError(f"{self.path} has been closed; open it again to write")
        try:
            return change_file(self.path, fill)
        except OSError as error:
            self.close()
            raise _storage_error(self.path, error) from error

    def close(self) -> None:
        """Release the lock of the shard; may be called repeatedly."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _batches(shard: Shard, names: Sequence[str]) -> Iterator[list[str]]:
    """Divide names into batches of about _BATCH bytes."""
    batch: list[str] = []
    size = 0
    for name in names:
        batch.append(name)
        size += shard.episode(name).nbytes
        if size > _BATCH:
            yield batch
            batch = []
            size = 0
    if batch:
        yield batch


def _make_empty(path: Path) -> None:
    make_file(
        path,
        {"format": FORMAT, "schema": VERSION, "mjhab": __version__},
        (EPISODES, RUNS),
    )


def _put_episode(parent: h5py.Group, data: EpisodeData) -> None:
    arrays = {**data.arrays, "record": record_bytes(data.record)}
    for path, array in arrays.items():
        _put(parent, path, array, data.columns.get(path))
    record = data.record
    values = {
        "seed": record.seed,
        "index": record.index,
        "run": data.run.id,
        "home": record.home,
        "model": data.model,
        "label": last_label(record),
        "success": record.success_once,
        "steps": record.steps,
        "ending": data.ending,
        "digest": episode_digest(arrays),
        "style": style_text(record),
        "actors": json.dumps(data.actors),
        "schema": data.schema,
    }
    put_attributes(parent, values)


def _put(
    parent: h5py.Group,
    path: str,
    array: np.ndarray,
    columns: tuple[str, ...] | None = None,
) -> None:
    array = np.ascontiguousarray(array)
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_obj_track_times(False)
    if array.nbytes < _SMALL:
        plist.set_layout(h5py.h5d.COMPACT)
    elif not path.startswith("images/"):
        # Frames are compressed already and read one at a time, so the dataset is contiguous and uncompressed.
        rows = max(1, min(len(array), _CHUNK // max(1, array.nbytes // len(array))))
        plist.set_chunk((rows, *array.shape[1:]))
        plist.set_shuffle()
        plist.set_deflate(_GZIP)
    folder, _, name = path.rpartition("/")
    place = parent.require_group(folder) if folder else parent
    space = h5py.h5s.create_simple(array.shape)
    kind = h5py.h5t.py_create(array.dtype, logical=True)
    dataset = h5py.Dataset(h5py.h5d.create(place.id, name.encode(), kind, space, plist))
    dataset[...] = array
    if columns:
        put_attributes(dataset, {COLUMNS: ",".join(columns)})


def is_full(error: Exception) -> bool:
    """Whether an error reports a full disk, by its errno or, for libraries without one, by its text."""
    number = getattr(error, "errno", None)
    return number in (errno.ENOSPC, errno.EDQUOT) or os.strerror(errno.ENOSPC) in str(
        error
    )


def _storage_error(path: Path, error: OSError) -> StorageError:
    if is_full(error):
        what = "the disk is full. Free some space and run the same command again: it continues where it stopped"
    else:
        what = f"{error.strerror or error}. Fix that and run the same command again"
    return StorageError(
        f"cannot write {path}: {what}. Every episode finished before is safe."
    )
