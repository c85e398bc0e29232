"""What is said when data cannot be written: a full or broken disk."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from mjhab.core.errors import MjhabError


class StorageError(MjhabError):
    """The disk is full or broken. Data written before are safe."""


def is_full(error: Exception) -> bool:
    """Whether an error reports a full disk, by its errno or, for libraries without one, by its text."""
    number = getattr(error, "errno", None)
    # A user's quota is as full as a disk, and has an errno of its own.
    return number in (errno.ENOSPC, errno.EDQUOT) or os.strerror(errno.ENOSPC) in str(
        error
    )


def reason_of(error: Exception) -> str:
    """What went wrong, in words of the system."""
    if is_full(error):
        return "the disk is full"
    return getattr(error, "strerror", None) or str(error)


def not_written(path: Path, error: OSError) -> StorageError:
    """Make the error for an episode that cannot be written."""
    fix = "Free some space" if is_full(error) else "Fix that"
    return StorageError(
        f"cannot write {path}: {reason_of(error)}. {fix} and run the same command again: it continues where it "
        "stopped. Every episode finished before is safe."
    )


def broken(out: Path, error: Exception) -> StorageError:
    """Make the error for a whole file that cannot be written."""
    fix = "free some space" if is_full(error) else "fix that"
    return StorageError(
        f"cannot write {out}: {reason_of(error)}. Nothing was left behind; {fix} and run the same command again."
    )
