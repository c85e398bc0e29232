"""One writer per file or folder: advisory locks that die with their process."""

from __future__ import annotations

import fcntl
import os
import socket
import time
from pathlib import Path

from mjhab.core.errors import UsageError

_TRIES = 10
"""Times that a writer asks for a lock: whoever looks if somebody writes holds it for an instant."""
_PAUSE_SECONDS = 0.01


def lock_path(path: Path) -> Path:
    """Where the lock of a file lies."""
    return path.with_name(f"{path.name}.lock")


class WriteLock:
    """Held while a file is open for writing, or a folder is being filled.

    A file system without such locks goes without.

    Args:
        path: the file; the lock is a file beside it.
        what: the folder that is being filled, for the message.

    Raises:
        UsageError: another process (or this one) is writing it.
    """

    def __init__(self, path: Path, what: Path | None = None) -> None:
        self._path = lock_path(path)
        left = _TRIES
        while True:
            self._fd = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                owner = _owner(self._fd)
                os.close(self._fd)
                left -= 1
                if not left:
                    raise _is_taken(path, what, owner) from error
                time.sleep(_PAUSE_SECONDS)
                continue
            except OSError:
                break
            if self._is_current():
                break
            # The owner before deleted the file between our two calls.
            os.close(self._fd)
        os.ftruncate(self._fd, 0)
        os.pwrite(
            self._fd, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0
        )

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
    """Whether some process is writing the file, or filling the folder whose lock it is, now."""
    return _writer(path) is not None


def refuse_if_written(path: Path, what: Path | None = None) -> None:
    """Do what `WriteLock` does where it is refused, and nothing else: for checks before long preparations.

    Raises:
        UsageError: another process (or this one) is writing it.
    """
    owner = _writer(path)
    if owner is not None:
        raise _is_taken(path, what, owner)


def _writer(path: Path) -> str | None:
    """Who holds the lock of a file, in words; None if nobody does."""
    try:
        fd = os.open(lock_path(path), os.O_RDONLY)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return _owner(fd)
    except OSError:
        return None
    finally:
        os.close(fd)
    return None


def _owner(fd: int) -> str:
    return os.pread(fd, 200, 0).decode(errors="replace").strip() or "another process"


def _is_taken(path: Path, what: Path | None, owner: str) -> UsageError:
    kind = "folder" if what else "file"
    return UsageError(
        f"{what or path} is being written by {owner}. Wait until it has finished, or write to another {kind}."
    )
