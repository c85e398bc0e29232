"""Recovery of episodes from a truncated shard, or one with a damaged index, by searching for their headers.

The index of episodes (a heap and a B-tree of HDF5) lies near the end of the file, so a truncated shard has lost it
although nearly all episodes are still there. An episode is stored in one contiguous piece, and each of its objects has
a header that starts with the same four bytes and has a checksum.
"""

from __future__ import annotations

import functools
import mmap
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from h5py import h5s, h5t

from mjhab.data.store.episode_data import from_bytes, run_id
from mjhab.data.store.hdf5 import read_attributes
from mjhab.data.store.reading import BROKEN, Shard

HEADER = b"OHDR"
"""First bytes of the header of a group or dataset (HDF5 format specification, data object headers of version 2)."""
MAX_RUN_BYTES = 1 << 20
"""Largest dataset that is considered as the description of a run [bytes]."""
_RUN_BEGINS = b'{"config":'


class Wreck(Shard):
    """A damaged shard: the episodes in its index, and all other episodes and runs found by their headers.

    ``indexed``: whether the index of episodes could be read; otherwise the number of lost episodes is unknown.
    """

    def _read_index(self) -> None:
        self.indexed = True
        self._references = _references(_header_offsets(self.path))
        try:
            super()._read_index()
        except BROKEN:
            self.indexed = False
            self._places = {}
        for reference in self._references:
            name = _episode_name(self.file, reference)
            if name:
                self._places.setdefault(name, reference)
        self.names = sorted(self._places)

    @functools.cached_property
    def told(self) -> dict[str, dict[str, Any]]:
        """JSON data of each run by name."""
        found = (_run(self.file, reference) for reference in self._references)
        told = {run_id(values): values for values in found if values is not None}
        with suppress(*BROKEN):
            told |= super().told
        return told


def _header_offsets(path: Path) -> list[int]:
    """Offsets in a file at which headers may start [bytes]."""
    found: list[int] = []
    with (
        open(path, "rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
    ):
        at = data.find(HEADER)
        while at >= 0:
            found.append(at)
            at = data.find(HEADER, at + len(HEADER))
    return found


def _references(offsets: Sequence[int]) -> list[h5py.Reference]:
    """HDF5 object references to the headers at these offsets.

    On the disk an object reference is the offset of a header, but h5py can only make one from an open object.
    """
    if not offsets:
        return []
    with h5py.File("references", "w", driver="core", backing_store=False) as memory:
        column = memory.create_dataset(
            "references", (len(offsets),), dtype=h5py.ref_dtype
        )
        column.id.write(h5s.ALL, h5s.ALL, np.array(offsets, "<u8"), h5t.STD_REF_OBJ)
        return list(column[()])


def _open(file: h5py.File, reference: h5py.Reference) -> Any:
    """Open the group or dataset of a reference; None if its header is not intact."""
    with suppress(*BROKEN):
        return file[reference]
    return None


def _episode_name(file: h5py.File, reference: h5py.Reference) -> str:
    """Name of the episode stored in this group, from its attributes; "" if it is not an episode."""
    found = _open(file, reference)
    if not isinstance(found, h5py.Group):
        return ""
    with suppress(*BROKEN, TypeError):
        told = read_attributes(found)
        config, _, _ = str(told["run"]).partition("-")
        return f"{config}-{int(told['seed'])}-{int(told['index']):07d}"
    return ""


def _run(file: h5py.File, reference: h5py.Reference) -> dict[str, Any] | None:
    """JSON data of the run that a dataset describes; None if it holds something else."""
    found = _open(file, reference)
    if not isinstance(found, h5py.Dataset) or found.dtype != np.uint8 or found.ndim != 1:
        return None
    if found.nbytes > MAX_RUN_BYTES:
        return None
    with suppress(*BROKEN):
        data = found[()]
        if data.tobytes().startswith(_RUN_BEGINS):
            return from_bytes(data)
    return None
