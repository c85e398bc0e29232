"""No reader opens a shard while it changes: an advisory lock that dies with its process."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def quiet(path: Path, change: bool = False) -> Iterator[None]:
    """Nobody else changes the shard meanwhile or, with ``change``, opens it either. For milliseconds.

    HDF5 that reads the index of a file while it changes may bring down its process. The lock is on the folder: who
    looks at a shard with h5py locks the file itself, for as long as it is open. A file system without such locks goes
    without.
    """
    fd = os.open(path.parent, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(fd, fcntl.LOCK_EX if change else fcntl.LOCK_SH)
        yield
    finally:
        os.close(fd)
