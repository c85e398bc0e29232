"""An advisory lock that keeps readers from opening a shard while it changes; it ends with its process."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def quiet(path: Path, change: bool = False) -> Iterator[None]:
    """Lock a shard for milliseconds against changes or, with ``change``, also against being opened.

    HDF5 may crash if it reads the index of a file that changes. The lock is on the folder, because h5py locks the file
    itself for as long as a reader has it open. File systems without such locks are used without one.
    """
    fd = os.open(path.parent, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(fd, fcntl.LOCK_EX if change else fcntl.LOCK_SH)
        yield
    finally:
        os.close(fd)
