"""Helpers for HDF5 files: whole new files, checking format and schema version, typed access to groups and datasets."""

from __future__ import annotations

import io
import math
import os
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mjhab.core.errors import fault
from mjhab.core.files.reading import reason
from mjhab.core.version import __version__
from mjhab.data.store.schema import EPISODES, FORMAT, OLDEST, RUNS, VERSION, DamagedError

# A damaged or malicious file of some kB may claim to unpack to TB.
MAX_UNPACKED_BYTES = 256 << 20
"""Datasets up to this size are read however well they are compressed [bytes]."""
MAX_UNPACKED_RATIO = 200
"""Compression that larger datasets may have; images, the only large ones, are stored uncompressed."""
LIBVER = ("v110", "v110")
"""File format of HDF5 1.10 (2016): files are small, and all current readers support it."""
BROKEN = (OSError, RuntimeError, ValueError, KeyError)
"""Exceptions that h5py raises for damaged files."""
UNREADABLE = (*BROKEN, TypeError, IndexError, OverflowError, MemoryError)
"""Exceptions of reading an episode whose parts have other types or shapes than the schema says."""
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_END_OF_FILE = 28
"""Offset of the file's length in a superblock of version 2 or 3 with 8-byte offsets (HDF5 format specification)."""


class _NewFile(io.RawIOBase):
    """A new file for h5py that keeps a full disk from HDF5, which may crash there: ``error`` is the first failure.

    What cannot be written is dropped from then on; whoever made the file raises the error and deletes it.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        # Unbuffered, so that a failed write is seen at once and not when the file is closed.
        self._file = io.FileIO(path, "w+b")
        self.error: OSError | None = None

    def readable(self) -> bool:
        """Yes."""
        return True

    def writable(self) -> bool:
        """Yes."""
        return True

    def seekable(self) -> bool:
        """Yes."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to an offset [bytes]."""
        return self._file.seek(offset, whence)

    def readinto(self, buffer) -> int:  # type: ignore[override]
        """Read into a buffer; what is not there, because the disk was full, are zeros."""
        view = memoryview(buffer).cast("B")
        count = self._file.readinto(view) or 0
        # HDF5 crashes on a short read of metadata that it believes it wrote.
        view[count:] = bytes(len(view) - count)
        return len(view)

    def write(self, data) -> int:  # type: ignore[override]
        """Write all of the data, unless something could not be written before."""
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view) and self.error is None:
            with self._noting():
                done += self._file.write(view[done:])
        # The whole length even after an error: HDF5 may abort the process on a short write.
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the length [bytes]."""
        with self._noting():
            self._file.truncate(size)
        return size or 0

    def sync(self) -> None:
        """Bring everything to the disk.

        Raises:
            OSError: something could not be written.
        """
        if self.error is None:
            os.fsync(self._file.fileno())
        else:
            raise self.error

    @contextmanager
    def _noting(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.error = error

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


@contextmanager
def new_file(
    path: Path, attributes: Mapping[str, Any], groups: Sequence[str] = ()
) -> Iterator[h5py.File]:
    """Context manager that yields a new HDF5 file beside ``path``, which takes its place at the end.

    A reader, or whoever looks after a kill, sees the old file or the whole new one, never half of one.

    Raises:
        OSError: the disk is full or broken; nothing has changed.
    """
    # The process and a random part, because threads and nodes of a cluster may share process numbers.
    temporary = path.with_name(f".{path.stem}-{os.getpid()}-{secrets.token_hex(4)}.h5")
    raw = _NewFile(temporary)
    try:
        try:
            with h5py.File(raw, "w", libver=LIBVER) as file:
                put_attributes(file, attributes)
                for name in groups:
                    file.create_group(name)
                yield file
        except (OSError, RuntimeError) as error:
            if raw.error is None:
                raise
            # HDF5 stumbles over what could not be written.
            raise raw.error from error
        # Before the rename, else a power failure could leave an empty file under the final name.
        raw.sync()
        os.replace(temporary, path)
        # The rename itself lies in the folder and not in the file.
        sync_folder(path.parent)
    finally:
        raw.close()
        # After the rename it is gone already.
        temporary.unlink(missing_ok=True)


def drop_unfinished(folder: Path, stem: str = "*") -> None:
    """Delete what killed writers had begun of files ``stem``.h5; nobody may be writing them."""
    for path in folder.glob(f".{stem}-*-*.h5") if folder.is_dir() else ():
        path.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Bring the names of the files in a folder to the disk."""
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def stated_length(path: Path) -> int:
    """Length of a shard according to its superblock [bytes].

    Raises:
        DamagedError: it is not an HDF5 file, or mjhab did not write it.
    """
    with open(path, "rb") as file:
        head = file.read(_END_OF_FILE + 8)
    if head[:8] != _SIGNATURE:
        raise DamagedError(
            f"{path} is not an HDF5 file: it does not begin with the signature of one."
        )
    if len(head) < _END_OF_FILE + 8 or head[8] not in (2, 3) or head[9] != 8:
        raise DamagedError(
            f"{path} is an HDF5 file of a kind that mjhab does not write; give a shard, as `mjhab generate` makes them."
        )
    return int.from_bytes(head[_END_OF_FILE:], "little")


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
    attributes = read_attributes(file)
    if attributes.get("format") != FORMAT:
        names = ", ".join(list(file)[:4]) or "nothing"
        raise DamagedError(
            f"{path} is an HDF5 file, but holds no episodes of mjhab (it holds {names}). Sets in the layout of "
            "ManiSkill or LeRobot are read with their own tools; mjhab writes them from shards."
        )
    version = int(attributes.get("schema", 0))
    if not OLDEST <= version <= VERSION:
        maker = str(attributes.get("mjhab", "?"))
        if version > VERSION:
            how = f"Update mjhab to {maker} or later."
        else:
            how = (
                f"Read it with mjhab {maker} in a separate environment, or record its episodes again: the same "
                "options of `mjhab generate` give the same seeds and indices."
            )
        raise fault(
            path,
            f"has schema {version} and was written by mjhab {maker}; this is mjhab {__version__}, which "
            f"reads schema {OLDEST} to {VERSION}. {how}",
        )
    missing = [name for name in (EPISODES, RUNS) if name not in file]
    if missing:
        raise DamagedError(
            f"{path} has lost its group {missing[0]!r}. Copy it again from where it came from."
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
    # A shard from elsewhere could read any file of this machine.
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
    # Does not follow links, so that loops and other files are left out.
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


def unreadable(path: Path, error: Exception) -> DamagedError:
    """The error for a file that cannot be read at all, with how it is damaged."""
    there = path.stat().st_size
    whole = stated_length(path)
    if there < whole:
        return DamagedError(
            f"{path} cannot be read: it is cut off, {there:,} of its {whole:,} bytes are there. Copy it again from "
            "where it came from."
        )
    return DamagedError(
        f"{path} cannot be read: {reason(error)}. Copy it again from where it came from."
    )
