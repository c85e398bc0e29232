"""Reading ``.npz`` files that others wrote: bounded before anything is unpacked, and one error for all damage."""

from __future__ import annotations

import lzma
import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np

from mjhab.core.errors import fault
from mjhab.core.files.reading import check_file, reason

_MB = 2**20
_SUFFIX = ".npy"
_DAMAGE = (
    OSError,
    ValueError,
    EOFError,
    RuntimeError,  # encrypted, or packed by a method that is not known (NotImplementedError)
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
)


class Arrays(Mapping[str, np.ndarray]):
    """The arrays of an opened file by name; each is unpacked when it is asked for.

    What it raises for damage, `open_arrays` turns into a UsageError.
    """

    def __init__(self, file: zipfile.ZipFile, most_mb: float) -> None:
        self._file = file
        self._most_mb = most_mb
        self._left = int(most_mb * _MB)
        self._entries = {
            info.filename.removesuffix(_SUFFIX): info
            for info in file.infolist()
            if info.filename.endswith(_SUFFIX)
        }

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __getitem__(self, name: str) -> np.ndarray:
        """An array.

        Raises:
            KeyError: there is none of this name.
            ValueError: it holds Python objects, is damaged, or the arrays that were read so far are larger than the
                limit together.
        """
        info = self._entries[name]
        # A small file may state, and hold, any size.
        self._left -= info.file_size
        if self._left < 0:
            raise ValueError(
                f"its arrays hold more than the {self._most_mb:g} MB that are read"
            )
        # Twice: a member of an archive cannot be rewound cheaply, and the header must be judged first.
        with self._file.open(info) as stream:
            _check_size(name, stream, info.file_size)
        with self._file.open(info) as stream:
            # Pickled objects run code of whoever wrote the file.
            return np.lib.format.read_array(stream, allow_pickle=False)


def _check_size(name: str, stream: IO[bytes], size: int) -> None:
    """Refuse an array whose header states another size than there is: numpy takes the memory first."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, _, kind = np.lib.format.read_array_header_1_0(stream)
    else:
        shape, _, kind = np.lib.format.read_array_header_2_0(stream)
    if (
        min(shape, default=0) < 0
        or math.prod(shape) * kind.itemsize != size - stream.tell()
    ):
        raise ValueError(f"array {name!r} has another size than its shape {shape} says")


@contextmanager
def open_arrays(
    path: Path, what: str, most_mb: float, remedy: str = "make it again"
) -> Iterator[Arrays]:
    """Open a file for reading its arrays.

    Args:
        path: the file.
        what: what it is, for the message: "spawn set".
        most_mb: of all arrays that are read together [MB], unpacked.
        remedy: what to do with a damaged file, for the message.

    Raises:
        UsageError: it is no such file, it is damaged or too large; also for what is read within this context.
    """
    check_file(path)
    try:
        with zipfile.ZipFile(path) as file:
            yield Arrays(file, most_mb)
    except KeyError as error:
        raise fault(path, f"array {error} is missing; this is no {what}.") from error
    except _DAMAGE as error:
        raise fault(
            path, f"no {what}, or is damaged ({reason(error)}); {remedy}."
        ) from error
