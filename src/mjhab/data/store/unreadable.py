"""How damaged shards show themselves, and what is said of them."""

from __future__ import annotations

from pathlib import Path

from mjhab.core.files.reading import reason
from mjhab.data.store.hdf5 import stated_length
from mjhab.data.store.older.journal import journal_path
from mjhab.data.store.schema import DamagedError

BROKEN = (OSError, RuntimeError, ValueError, KeyError)
"""Exceptions that h5py raises for damaged files."""
UNREADABLE = (*BROKEN, TypeError, IndexError, OverflowError, MemoryError)
"""Exceptions of reading an episode whose parts have other types or shapes than the schema says."""


def refuse_journal(path: Path) -> None:
    """Refuse a shard that a writer of an older version was changing when it was killed.

    Raises:
        DamagedError: its journal is still there.
    """
    if journal_path(path).exists():
        raise DamagedError(
            f"{path} has a change that a killed writer of mjhab 0.1 did not finish. Finish it with: mjhab data repair "
            f"{path}"
        )


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
