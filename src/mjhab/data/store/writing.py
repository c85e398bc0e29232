"""Whole new files of episodes: of one just recorded, and shards of many that other files hold.

A file is written beside its place and renamed when all of it is on the disk (`hdf5.new_file`), and never changed
afterwards. So a kill or a full disk at any moment takes at most what is being written, and a reader needs no lock.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np

from mjhab.core.version import __version__
from mjhab.data.store.episode_data import (
    EpisodeData,
    episode_digest,
    last_label,
    record_bytes,
    style_text,
    to_bytes,
)
from mjhab.data.store.hdf5 import group, new_file, put_attributes, read_arrays
from mjhab.data.store.reading import open_shard
from mjhab.data.store.schema import COLUMNS, EPISODES, FORMAT, RUNS, VERSION
from mjhab.rollout.records import EpisodeRecord

_GZIP = 4
_SMALL = 256
"""Arrays smaller than this are stored uncompressed in the header of their dataset [bytes]."""
_CHUNK = 4 << 20
"""Largest HDF5 chunk [bytes]."""
_ROOT = {"format": FORMAT, "schema": VERSION, "mjhab": __version__}


def write_episode(path: Path, data: EpisodeData) -> str:
    """Write a file of one episode; returns its digest.

    Raises:
        OSError: the disk is full or broken; there is no file.
    """
    with new_file(path, _ROOT, (EPISODES, RUNS)) as file:
        _put(group(file, RUNS), data.run.id, to_bytes(vars(data.run)))
        return _put_episode(group(file, EPISODES).create_group(data.name), data)


def write_shard(
    path: Path,
    sources: Mapping[Path, Sequence[str]],
    records: Mapping[str, EpisodeRecord] | None = None,
) -> None:
    """Write a file of episodes that other files, or the present one at ``path``, hold; their bytes stay the same.

    Args:
        path: the file to make or to replace.
        sources: names of episodes by the file that holds them; none is there twice.
        records: new records of some of them, by name.

    Raises:
        OSError: the disk is full or broken; nothing has changed.
        DamagedError: an episode cannot be read; nothing has changed.
    """
    with new_file(path, _ROOT, (EPISODES, RUNS)) as file:
        # Runs are shared by many episodes, and stored once per file.
        runs = group(file, RUNS)
        episodes = group(file, EPISODES)
        for source, names in sources.items():
            with open_shard(source) as shard:
                for name in names:
                    episode = shard.episode(name)
                    # HDF5 copies compressed chunks as they are, so that the digest still holds.
                    episode.copy_to(episodes)
                    run = str(episode.attributes["run"])
                    if run not in runs:
                        _put(runs, run, to_bytes(episode.run_data))
        for name, record in (records or {}).items():
            _replace_record(group(episodes, name), record)


def _replace_record(episode: h5py.Group, record: EpisodeRecord) -> None:
    # The new record may have another length, which a dataset cannot take.
    del episode["record"]
    _put(episode, "record", record_bytes(record))
    # The digest covers the record, so that it changes with it.
    digest = episode_digest(read_arrays(episode))
    put_attributes(episode, {"label": last_label(record), "digest": digest})


def _put_episode(parent: h5py.Group, data: EpisodeData) -> str:
    """Fill the group of an episode; returns its digest."""
    arrays = {**data.arrays, "record": record_bytes(data.record)}
    for path, array in arrays.items():
        _put(parent, path, array, data.columns.get(path))
    record = data.record
    digest = episode_digest(arrays)
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
        "digest": digest,
        "style": style_text(record),
        "actors": json.dumps(data.actors),
        "schema": data.schema,
    }
    put_attributes(parent, values)
    return digest


def _put(
    parent: h5py.Group,
    path: str,
    array: np.ndarray,
    columns: tuple[str, ...] | None = None,
) -> None:
    array = np.ascontiguousarray(array)
    # The low-level calls, because h5py's own interface has no compact layout.
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    # Times in the file would make equal episodes differ.
    plist.set_obj_track_times(False)
    if array.nbytes < _SMALL:
        plist.set_layout(h5py.h5d.COMPACT)
    elif not path.startswith("images/"):
        # Frames are compressed already and read one at a time, so the dataset is contiguous and uncompressed.
        rows = max(1, min(len(array), _CHUNK // max(1, array.nbytes // len(array))))
        plist.set_chunk((rows, *array.shape[1:]))
        # Bytes of equal rank side by side compress floats much better.
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
