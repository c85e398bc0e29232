"""Telling our HDF5 files from others, this version of the schema from others, groups from datasets."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from mjhab.core.errors import UsageError
from mjhab.data.schema import EPISODES, FORMAT, RUNS, VERSION, DamagedError


def check_format(file: h5py.File, path: Path) -> None:
    """Refuse files that this version of mjhab cannot read.

    Raises:
        DamagedError: some other HDF5 file, or one that lost its parts.
        UsageError: a shard of another schema version; the message says how to read it.
    """
    if file.attrs.get("format") != FORMAT:
        names = ", ".join(list(file)[:4]) or "nothing"
        raise DamagedError(
            f"{path} is an HDF5 file, but holds no episodes of mjhab (it holds {names}). Sets in the layout of "
            "ManiSkill or LeRobot are read with their own tools; mjhab writes them from shards."
        )
    version = int(file.attrs.get("schema", 0))
    if version != VERSION:
        maker = str(file.attrs.get("mjhab", "?"))
        raise UsageError(
            f"{path} has schema {version} and was written by mjhab {maker}; this mjhab reads schema {VERSION}. "
            f"Read it with mjhab {maker}, or record its episodes anew: they are functions of config, seed and index."
        )
    missing = [name for name in (EPISODES, RUNS) if name not in file]
    if missing:
        raise DamagedError(f"{path} has lost its group {missing[0]!r}. Try: mjhab data repair {path}")


def group(parent: h5py.Group, path: str) -> h5py.Group:
    """The group at a path.

    Raises:
        KeyError: there is none.
    """
    item = parent[path]
    if not isinstance(item, h5py.Group):
        raise KeyError(f"{path} is no group")
    return item


def dataset(parent: h5py.Group, path: str) -> h5py.Dataset:
    """The dataset at a path.

    Raises:
        KeyError: there is none.
    """
    item = parent[path]
    if not isinstance(item, h5py.Dataset):
        raise KeyError(f"{path} is no dataset")
    return item


def dataset_paths(parent: h5py.Group) -> list[str]:
    """Paths of all datasets in a group and the groups in it."""
    found: list[str] = []
    parent.visititems(lambda path, item: found.append(path) if isinstance(item, h5py.Dataset) else None)
    return found


def read_arrays(parent: h5py.Group) -> dict[str, np.ndarray]:
    """Every dataset in a group by its path."""
    return {path: dataset(parent, path)[()] for path in dataset_paths(parent)}
