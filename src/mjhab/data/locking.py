"""One writer per shard, and no reader opens it while it changes: advisory locks that die with their process."""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mjhab.core.errors import UsageError


def lock_path(path: Path) -> Path:
    """Where the lock of a shard lies."""
    return path.with_name(f"{path.name}.lock")


class WriteLock:
    """Held while a shard is open for writing, or a folder that ``what`` names is being filled.

    Raises:
        UsageError: another process (or this one) is writing the shard.
    """

    def __init__(self, path: Path, what: Path | None = None) -> None:
        self._path = lock_path(path)
        while True:
            self._fd = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                owner = os.pread(self._fd, 200, 0).decode(errors="replace").strip()
                os.close(self._fd)
                raise UsageError(
                    f"{what or path} is being written by {owner or 'another process'}. Wait until it has finished, or "
                    f"write to another {'folder' if what else 'file'}."
                ) from error
            if self._is_current():
                break
            # The owner before deleted the file between our two calls.
            os.close(self._fd)
        os.ftruncate(self._fd, 0)
        os.pwrite(self._fd, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)

    def _is_current(self) -> bool:
        try:
            return os.path.samestat(os.fstat(self._fd), os.stat(self._path))
        except FileNotFoundError:
            return False

    def release(self) -> None:
        """Let others write. Call it once."""
        # Deleted while still locked: whoever opened it meanwhile sees that its file is gone and opens a new one.
        self._path.unlink(missing_ok=True)
        os.close(self._fd)


def is_written(path: Path) -> bool:
    """Whether some process has the shard open for writing now."""
    try:
        fd = os.open(lock_path(path), os.O_RDONLY)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(fd)
    return False


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
