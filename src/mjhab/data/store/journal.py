"""Appending to an HDF5 file so that a kill at any moment leaves it readable.

The HDF5 library changes a file in many places and in no defined order: a kill in between may destroy all of it. Here
HDF5 writes into an `Overlay` in memory, and `commit` brings its changes to the disk in four steps:

1. write the new bytes beyond the present end (HDF5 ignores them until the superblock contains the new length);
2. write the changed old pages into a journal beside the file, followed by a hash;
3. write the same pages into the file;
4. delete the journal.

No process opens the file during steps 2 to 4 (`locking.quiet`). Processes that have it open can continue to read: of
the parts in use, only the index of episodes and the superblock change, and these were read on opening.

After a kill in step 1 or 2 the file is unchanged, and the journal is absent or its hash is wrong. After a kill in step
3 or 4 the journal is complete, and `recover` repeats step 3. Each step is on the disk (fsync) before the next starts.
"""

from __future__ import annotations

import hashlib
import io
import os
import struct
from dataclasses import dataclass
from pathlib import Path

from mjhab.core.files.locking import quiet
from mjhab.data.store.schema import DamagedError

PAGE = 4096
SIGNATURE = b"\x89HDF\r\n\x1a\n"
_MAGIC = b"mjhab journal 1\n"
_HEAD = struct.Struct("<QQ32sI")
_PART = struct.Struct("<QI")
_END_OF_FILE = 28
"""Offset of the file's length in a superblock of version 2 or 3 with 8-byte offsets (HDF5 format specification)."""


@dataclass(frozen=True)
class Journal:
    """A complete journal.

    before, after: length of the file before and after the commit [bytes]. first_page: hash of the file's first page
    before the commit. pages: new content of old pages by page number.
    """

    before: int
    after: int
    first_page: bytes
    pages: dict[int, bytes]


def journal_path(path: Path) -> Path:
    """Path of a shard's journal."""
    return path.with_name(f"{path.name}.journal")


class Overlay(io.RawIOBase):
    """A file object for h5py that combines a file with changes in memory.

    Args:
        fd: descriptor of the file, open for reading.
        length: of the file [bytes]; bytes beyond it are ignored.
        pages: initial changes by page number.
    """

    def __init__(
        self, fd: int, length: int, pages: dict[int, bytes] | None = None
    ) -> None:
        super().__init__()
        self._fd = fd
        self.base = length
        self.pages = {number: bytearray(data) for number, data in (pages or {}).items()}
        self.tail = bytearray()
        self._at = 0

    @property
    def length(self) -> int:
        """Length of the file with its changes [bytes]."""
        return self.base + len(self.tail)

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
        """Move to an offset."""
        self._at = (
            offset
            + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self.length}[whence]
        )
        return self._at

    def tell(self) -> int:
        """The current offset [bytes]."""
        return self._at

    def readinto(self, buffer) -> int:  # type: ignore[override]
        """Read into a buffer from the current offset; returns the number of bytes read."""
        view = memoryview(buffer).cast("B")
        count = max(0, min(len(view), self.length - self._at))
        view[:count] = self._read(self._at, count)
        self._at += count
        return count

    def write(self, data) -> int:  # type: ignore[override]
        """Write at the current offset, in memory."""
        view = memoryview(data).cast("B")
        old = max(0, min(len(view), self.base - self._at))
        if old:
            self._write_pages(self._at, view[:old])
        if old < len(view):
            start = self._at + old - self.base
            self.tail.extend(bytes(max(0, start - len(self.tail))))
            self.tail[start : start + len(view) - old] = view[old:]
        self._at += len(view)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the length [bytes], which is never less than the original length of the file."""
        size = max(self._at if size is None else size, self.base)
        del self.tail[size - self.base :]
        self.tail.extend(bytes(size - self.length))
        return size

    def _read(self, at: int, count: int) -> bytearray:
        old = max(0, min(count, self.base - at))
        out = bytearray(os.pread(self._fd, old, at)) if old else bytearray()
        if len(out) < old:
            raise DamagedError(f"the file ends {old - len(out)} bytes early")
        for number in range(at // PAGE, -(-(at + old) // PAGE)) if old else ():
            page = self.pages.get(number)
            if page is not None:
                low = max(at, number * PAGE)
                high = min(at + old, number * PAGE + len(page))
                if low < high:  # a page that was the last one may be short
                    out[low - at : high - at] = page[
                        low - number * PAGE : high - number * PAGE
                    ]
        start = at + old - self.base
        return out + self.tail[start : start + count - old]

    def _write_pages(self, at: int, view: memoryview) -> None:
        end = at + len(view)
        for number in range(at // PAGE, -(-end // PAGE)):
            start = number * PAGE
            if number not in self.pages:
                self.pages[number] = self._read(start, min(PAGE, self.base - start))
            low = max(at, start)
            high = min(end, start + PAGE)
            self.pages[number][low - start : high - start] = view[low - at : high - at]


def committed_length(path: Path) -> int:
    """Length of a shard according to its superblock [bytes]; bytes beyond it belong to an unfinished write.

    Raises:
        DamagedError: it is not an HDF5 file, or mjhab did not write it.
    """
    with open(path, "rb") as file:
        head = file.read(_END_OF_FILE + 8)
    if head[:8] != SIGNATURE:
        raise DamagedError(
            f"{path} is not an HDF5 file: it does not begin with the signature of one."
        )
    if len(head) < _END_OF_FILE + 8 or head[8] not in (2, 3) or head[9] != 8:
        raise DamagedError(
            f"{path} is an HDF5 file of a kind that mjhab does not write; give a shard, as `mjhab generate` makes them."
        )
    return int.from_bytes(head[_END_OF_FILE:], "little")


def commit(path: Path, overlay: Overlay) -> None:
    """Write the changes of an overlay to ``path`` atomically for all processes that open it later.

    Raises:
        OSError: the disk is full or broken. If the journal was not complete, the file is restored.
    """
    fd = os.open(path, os.O_RDWR)
    try:
        try:
            _write(fd, overlay.base, overlay.tail)
            os.fsync(fd)
        except OSError:
            os.ftruncate(fd, overlay.base)
            raise
        with quiet(path, change=True):
            _put_in_place(path, fd, overlay)
    finally:
        os.close(fd)
    sync_folder(path)


def _put_in_place(path: Path, fd: int, overlay: Overlay) -> None:
    journal = journal_path(path)
    try:
        _write_journal(journal, _pack(fd, overlay))
    except OSError:
        journal.unlink(missing_ok=True)
        os.ftruncate(fd, overlay.base)
        raise
    _apply(fd, {n: bytes(data) for n, data in overlay.pages.items()})
    journal.unlink()


def recover(path: Path) -> bool:
    """Complete or undo the last commit of a killed writer; returns whether it was completed.

    Raises:
        DamagedError: the journal belongs to another file.
        OSError: the disk is full or broken.
    """
    with quiet(path, change=True):
        journal = read_journal(path)
        if journal is not None:
            fd = os.open(path, os.O_RDWR)
            try:
                _apply(fd, journal.pages)
            finally:
                os.close(fd)
        journal_path(path).unlink(missing_ok=True)
        length = committed_length(path)
        if path.stat().st_size > length:
            os.truncate(path, length)
    return journal is not None


def read_journal(path: Path) -> Journal | None:
    """Read the journal of a shard; None if there is no complete one.

    Raises:
        DamagedError: the journal belongs to another file.
    """
    try:
        data = journal_path(path).read_bytes()
    except FileNotFoundError:
        return None
    body = data[:-32]
    digest = data[-32:]
    if not body.startswith(_MAGIC) or hashlib.sha256(body).digest() != digest:
        return None
    journal = _unpack(body)
    with open(path, "rb") as file:
        page = file.read(min(PAGE, journal.before))
        size = os.fstat(file.fileno()).st_size
    known = (journal.first_page, hashlib.sha256(journal.pages.get(0, b"")).digest())
    if size < journal.after or hashlib.sha256(page).digest() not in known:
        raise DamagedError(
            f"{journal_path(path)} does not belong to {path.name}, which was replaced or cut. Put back the file it "
            "belongs to, or delete the journal."
        )
    return journal


def sync_folder(path: Path) -> None:
    """Flush the directory entry of ``path`` to the disk."""
    fd = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _pack(fd: int, overlay: Overlay) -> bytes:
    first = hashlib.sha256(os.pread(fd, min(PAGE, overlay.base), 0)).digest()
    parts = [_MAGIC, _HEAD.pack(overlay.base, overlay.length, first, len(overlay.pages))]
    for number, page in sorted(overlay.pages.items()):
        parts += [_PART.pack(number, len(page)), bytes(page)]
    body = b"".join(parts)
    return body + hashlib.sha256(body).digest()


def _unpack(body: bytes) -> Journal:
    before, after, first, count = _HEAD.unpack_from(body, len(_MAGIC))
    at = len(_MAGIC) + _HEAD.size
    pages = {}
    for _ in range(count):
        number, size = _PART.unpack_from(body, at)
        at += _PART.size + size
        pages[number] = body[at - size : at]
    return Journal(before, after, first, pages)


def _write_journal(path: Path, data: bytes) -> None:
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
    try:
        _write(fd, 0, data)
        os.fsync(fd)
    finally:
        os.close(fd)
    sync_folder(path)


def _apply(fd: int, pages: dict[int, bytes]) -> None:
    # The first page holds the superblock. It is written last, because it makes the changes valid.
    for number in sorted(pages, reverse=True):
        _write(fd, number * PAGE, pages[number])
    os.fsync(fd)


def _write(fd: int, at: int, data: bytes | bytearray) -> None:
    view = memoryview(data)
    while view:
        done = os.pwrite(fd, view, at)
        view = view[done:]
        at = at + done
