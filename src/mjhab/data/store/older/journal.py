"""Journals of mjhab 0.1, which changed shards in place: finishing the change that a killed writer of that version left.

Such a writer put new bytes behind the end of the shard, the changed old pages into ``<shard>.journal``, closed by a
SHA-256, and then the same pages into the shard. With a whole journal the last step can be repeated; without one the
shard is what it was before.
"""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Iterator
from pathlib import Path

from mjhab.data.store.hdf5 import stated_length
from mjhab.data.store.schema import DamagedError

_PAGE = 4096
_MAGIC = b"mjhab journal 1\n"
_HEAD = struct.Struct("<QQ32sI")
"""Length of the shard before and after [bytes], hash of its first page before, number of pages."""
_PART = struct.Struct("<QI")
"""Number of a page and its size [bytes], before its content."""
_DIGEST = 32


def journal_path(path: Path) -> Path:
    """Path of a shard's journal."""
    return path.with_name(f"{path.name}.journal")


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


def finish_change(path: Path) -> bool:
    """Complete or undo the last change of a killed writer; returns whether there was a journal.

    Raises:
        DamagedError: the journal belongs to another file, or the file is no shard.
        OSError: the disk is full or broken.
    """
    stated_length(path)
    journal = journal_path(path)
    there = journal.exists()
    if there:
        _apply(path, journal)
        journal.unlink()
    length = stated_length(path)
    if path.stat().st_size > length:
        # Bytes past the stated end were appended by a change that never became valid.
        os.truncate(path, length)
    return there


def _apply(path: Path, journal: Path) -> None:
    data = journal.read_bytes()
    body = data[:-_DIGEST]
    whole = hashlib.sha256(body).digest() == data[-_DIGEST:]
    # A journal that is cut off was written before the shard was touched: nothing is to be done.
    if not (whole and body.startswith(_MAGIC)):
        return
    before, after, first, count = _HEAD.unpack_from(body, len(_MAGIC))
    pages = dict(_pages(body, count))
    with open(path, "r+b") as file:
        page = file.read(min(_PAGE, before))
        known = (first, hashlib.sha256(pages.get(0, b"")).digest())
        size = os.fstat(file.fileno()).st_size
        # The first page is the old one before the change and the new one if only the deletion is missing.
        if size < after or hashlib.sha256(page).digest() not in known:
            raise DamagedError(
                f"{journal} does not belong to {path.name}, which was replaced or cut. Put back the file it belongs "
                "to, or delete the journal."
            )
        # The first page makes the change valid, so it comes last.
        for number in sorted(pages, reverse=True):
            file.seek(number * _PAGE)
            file.write(pages[number])
        file.flush()
        os.fsync(file.fileno())


def _pages(body: bytes, count: int) -> Iterator[tuple[int, bytes]]:
    at = len(_MAGIC) + _HEAD.size
    for _ in range(count):
        number, size = _PART.unpack_from(body, at)
        at += _PART.size + size
        yield number, body[at - size : at]
