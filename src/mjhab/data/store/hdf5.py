"""Helpers for HDF5 files: checking format and schema version, typed access to groups and datasets, atomic changes.

The HDF5 library never writes to the disk itself here: on a full disk it may crash the process.
"""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mjhab.core.errors import UsageError
from mjhab.core.version import __version__
from mjhab.data.store.journal import Overlay, commit, committed_length
from mjhab.data.store.schema import EPISODES, FORMAT, OLDEST, RUNS, VERSION, DamagedError

MAX_UNPACKED_BYTES = 256 << 20
"""Datasets up to this size are read however well they are compressed [bytes]."""
MAX_UNPACKED_RATIO = 200
"""Compression that larger datasets may have; images, the only large ones, are stored uncompressed."""
LIBVER = ("v110", "v110")
"""File format of HDF5 1.10 (2016): files are small, and all current readers support it."""


def make_file(
    path: Path, attributes: Mapping[str, Any], groups: Sequence[str] = ()
) -> None:
    """Write a new HDF5 file with attributes and empty groups to the disk.

    Raises:
        OSError: the disk is full or broken.
    """
    memory = io.BytesIO()
    with h5py.File(memory, "w", libver=LIBVER) as file:
        put_attributes(file, attributes)
        for name in groups:
            file.create_group(name)
    with open(path, "wb") as out:
        out.write(memory.getvalue())
        out.flush()
        os.fsync(out.fileno())


def change_file(path: Path, fill: Callable[[h5py.File], None]) -> int:
    """Apply the changes of ``fill`` to a file of `make_file` atomically; returns by how many bytes it has grown.

    Raises:
        OSError: the disk is full or broken; the file is unchanged.
    """
    fd = os.open(path, os.O_RDONLY)
    try:
        overlay = Overlay(fd, committed_length(path))
        with h5py.File(overlay, "r+", libver=LIBVER) as file:
            fill(file)
        commit(path, overlay)
    finally:
        os.close(fd)
    return len(overlay.tail)


def put_attributes(item: h5py.Group | h5py.Dataset, values: Mapping[str, Any]) -> None:
    """Set attributes of a group or dataset; text is stored with fixed length.

    h5py's default, text of variable length, is stored in the only part of the file without a checksum: a flipped bit
    there changes the text unnoticed, or sends HDF5 into an endless loop.
    """
    for name, value in values.items():
        if isinstance(value, str):
            data = value.encode()
            item.attrs.create(
                name, data, dtype=h5py.string_dtype("utf-8", max(1, len(data)))
            )
        else:
            item.attrs[name] = value


def read_attributes(item: h5py.Group | h5py.Dataset) -> dict[str, Any]:
    """The attributes of a group or dataset as Python values."""
    return {str(name): _plain(value) for name, value in item.attrs.items()}


def _plain(value: Any) -> Any:
    value = value.item() if isinstance(value, np.generic) else value
    return value.decode() if isinstance(value, bytes) else value


def check_format(file: h5py.File, path: Path) -> int:
    """Refuse files that this version of mjhab cannot read; returns the schema version.

    Raises:
        DamagedError: it is not a shard, or parts are missing.
        UsageError: the schema version is not supported; the message says how to read the shard.
    """
    told = read_attributes(file)
    if told.get("format") != FORMAT:
        names = ", ".join(list(file)[:4]) or "nothing"
        raise DamagedError(
            f"{path} is an HDF5 file, but holds no episodes of mjhab (it holds {names}). Sets in the layout of "
            "ManiSkill or LeRobot are read with their own tools; mjhab writes them from shards."
        )
    version = int(told.get("schema", 0))
    if not OLDEST <= version <= VERSION:
        maker = str(told.get("mjhab", "?"))
        if version > VERSION:
            how = f"Update mjhab to {maker} or later."
        else:
            how = (
                f"Read it with mjhab {maker} in a separate environment, or record its episodes again: the same "
                "options of `mjhab generate` give the same seeds and indices."
            )
        raise UsageError(
            f"{path} has schema {version} and was written by mjhab {maker}; this is mjhab {__version__}, which "
            f"reads schema {OLDEST} to {VERSION}. {how}"
        )
    missing = [name for name in (EPISODES, RUNS) if name not in file]
    if missing:
        raise DamagedError(
            f"{path} has lost its group {missing[0]!r}. Try: mjhab data repair {path}"
        )
    return version


def group(parent: h5py.Group, path: str | h5py.Reference) -> h5py.Group:
    """The group at a path or reference.

    Raises:
        KeyError: there is none.
    """
    item = parent[path]
    if not isinstance(item, h5py.Group):
        raise KeyError(f"{path} is not a group")
    return item


def dataset(parent: h5py.Group, path: str) -> h5py.Dataset:
    """The dataset at a path.

    Raises:
        KeyError: there is none.
        ValueError: its data lie in another file.
    """
    item = parent[path]
    if not isinstance(item, h5py.Dataset):
        raise KeyError(f"{path} is not a dataset")
    if item.is_virtual or item.external or item.file.id != parent.file.id:
        raise ValueError(f"the data of {path} lie in another file")
    return item


def content(item: h5py.Dataset) -> np.ndarray:
    """The whole array of a dataset.

    Raises:
        ValueError: it unpacks to far more than it takes in the file, as no data of a robot do.
    """
    size = _nbytes(item)
    if (
        size > MAX_UNPACKED_BYTES
        and size > MAX_UNPACKED_RATIO * item.id.get_storage_size()
    ):
        raise ValueError(
            f"{item.name} unpacks to {size:,} bytes, more than {MAX_UNPACKED_RATIO} times what it takes in the file"
        )
    return np.asarray(item[()])


def _nbytes(item: h5py.Dataset) -> int:
    return math.prod(int(side) for side in item.shape or ()) * item.dtype.itemsize


def dataset_paths(parent: h5py.Group) -> list[str]:
    """Paths of all datasets in a group and its subgroups."""
    found: list[str] = []
    parent.visititems(
        lambda path, item: found.append(path) if isinstance(item, h5py.Dataset) else None
    )
    return found


def read_arrays(parent: h5py.Group) -> dict[str, np.ndarray]:
    """Every dataset in a group by its path.

    Raises:
        ValueError: see `content`.
    """
    return {path: content(dataset(parent, path)) for path in dataset_paths(parent)}
