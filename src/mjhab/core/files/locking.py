"""One writer per file or folder: advisory locks that die with their process.

The one module that knows how the system locks. Writers use `filelock`. Whoever only looks asks the system itself
(``flock``), for a shared lock that writes nothing: a data set may lie on a read-only disk, and two who look must not
take each other for a writer. filelock has such a lock only as an SQLite file beside (3.4 ms per use on two busy cores;
``flock`` takes 0.02 ms). Systems without ``flock`` go without.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from pathlib import Path

from mjhab.core.errors import UsageError, fault

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

_WAIT_SECONDS = 0.1
"""Time that a writer asks for a lock: whoever looks if somebody writes holds it for an instant."""
_PAUSE_SECONDS = 0.01
_WITHOUT_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK)
"""What a file system says that has no such locks."""


def lock_path(path: Path) -> Path:
    """Where the lock of a file lies."""
    return path.with_name(f"{path.name}.lock")


class WriteLock:
    """Held while a file is open for writing, or a folder is being filled; a context manager.

    A file system without such locks goes without.

    Args:
        path: the file; the lock is a file beside it.
        what: the folder that is being filled, for the message.

    Raises:
        UsageError: another process (or this one) is writing it.
        OSError: no file can be made there.
    """

    def __init__(self, path: Path, what: Path | None = None) -> None:
        from filelock import FileLock, Timeout  # who only reads does not pay for it

        self._path = lock_path(path)
        # No soft locks: they outlive a process that is killed.
        self._lock = FileLock(self._path, thread_local=False, fallback_to_soft=False)
        try:
            self._lock.acquire(timeout=_WAIT_SECONDS, poll_interval=_PAUSE_SECONDS)
        except Timeout as error:
            raise _is_taken(path, what, _owner(self._path)) from error
        except OSError as error:
            if error.errno not in _WITHOUT_LOCKS:
                raise
        self._is_held = True
        # Only the message of who is refused is poorer without it.
        with contextlib.suppress(OSError):
            # With the machine, because the number of a process means nothing on another one.
            self._path.write_text(f"process {os.getpid()} on {socket.gethostname()}\n")

    def __enter__(self) -> WriteLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """Let others write; a second call does nothing."""
        if not self._is_held:
            return
        self._is_held = False
        # Deleted while still locked: whoever opened it meanwhile sees that its file is gone and opens a new one.
        with contextlib.suppress(OSError):
            self._path.unlink()
        self._lock.release()


def is_written(path: Path) -> bool:
    """Whether some process is writing the file, or filling the folder whose lock it is, now."""
    try:
        fd = os.open(lock_path(path), os.O_RDONLY)
    except FileNotFoundError:
        return False
    try:
        return not _share(fd)
    finally:
        os.close(fd)


def refuse_if_written(path: Path, what: Path | None = None) -> None:
    """Do what `WriteLock` does where it is refused, and nothing else: for checks before long preparations.

    Raises:
        UsageError: another process (or this one) is writing it.
    """
    if is_written(path):
        raise _is_taken(path, what, _owner(lock_path(path)))


def _share(fd: int) -> bool:
    """Take a shared lock until ``fd`` is closed; False if a writer has the file."""
    if fcntl is not None:
        try:
            fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            pass  # a file system without locks
    return True


def _owner(lock: Path) -> str:
    """Who wrote the lock file, in words."""
    with contextlib.suppress(OSError):
        # Cut and lenient: the file is of another process, which may just be writing it.
        said = lock.read_text(encoding="utf-8", errors="replace")[:200].strip()
        return said or "another process"
    return "another process"


def _is_taken(path: Path, what: Path | None, owner: str) -> UsageError:
    kind = "folder" if what else "file"
    problem = f"is being written by {owner}. Wait until it has finished, or write to another {kind}."
    return fault(what or path, problem)
