"""Unpack archives that somebody else made: nothing may land outside the folder.

Our own and not ``tarfile``'s data filter or ``shutil.unpack_archive``: these unpack before they know how much there is,
write links, read headers of any stated length, stop before the checksum of the compression, and `zipfile` mends paths
where they should be refused. Each of these is a test in ``tests/assets/test_archives.py``.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import shutil
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import IO, Any, cast

from mjhab.core.errors import UsageError, fault

_LINK = 0o120000
MAX_UNPACKED_BYTES = 50e9
LEAST_UNPACKED_BYTES = 1e9
MAX_RATIO = 50
"""Limits of an archive's content, in all and times its own size above the least; data sets have a ratio below 10."""
MAX_HEADER_BYTES = 2**20
"""Longest header of a file in a tar archive."""
_COMPRESSED: dict[bytes, Callable[[Path], Any]] = {
    b"\x1f\x8b": gzip.GzipFile,
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ": lzma.LZMAFile,
}
"""What reads an archive that begins with these bytes."""
_DAMAGE = (
    zipfile.BadZipFile,
    tarfile.TarError,
    EOFError,
    zlib.error,
    lzma.LZMAError,
    NotImplementedError,
    ValueError,
)
Member = tuple[str, int, Callable[[], IO[bytes]]]
"""Path, size [bytes], and what opens it."""


def safe_path(path: str, where: str) -> str:
    """A relative path that stays below its folder on every system, without ``.`` parts.

    Raises:
        UsageError: it is absolute, climbs out with ``..``, or uses what some system takes for a drive or separator.
    """
    parts = [part for part in PurePosixPath(path).parts if part != "."]
    # Backslashes, drives and streams of Windows too: an archive should mean the same everywhere.
    bad = path.startswith("/") or ".." in parts or any(sign in path for sign in "\\:\0")
    if bad or not parts:
        raise fault(
            where, f"the path {path!r} leads out of the folder; nothing was installed."
        )
    return "/".join(parts)


def unpack(archive: Path, folder: Path) -> None:
    """Write the files of a zip or tar archive into ``folder``, which is made if missing.

    Raises:
        UsageError: it is no archive, it is damaged, or it holds links, devices or paths that lead out of the folder.
    """
    try:
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as file:
                _write(_zip_members(file, archive), folder, archive)
        else:
            with _plain(archive) as content:
                _write(_tar_members(content, archive), folder, archive)
                _read_to_end(content, archive)
    except (OSError, *_DAMAGE) as error:
        # An error of the system has a number; those of bz2 and gzip for damaged data have none.
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise fault(
            archive,
            f"damaged, or neither a zip nor a tar archive ({error}); nothing was installed.",
        ) from error


def _plain(archive: Path) -> IO[bytes]:
    """A tar archive without its compression."""
    with archive.open("rb") as file:
        # By its first bytes, since the name of a download says nothing.
        begin = file.read(max(map(len, _COMPRESSED)))
    for magic, opened in _COMPRESSED.items():
        if begin.startswith(magic):
            return opened(archive)
    return archive.open("rb")


def _read_to_end(content: IO[bytes], archive: Path) -> None:
    """Read what is left of a stream: the checksum of its compression comes last, after the end of the tar archive.

    Raises:
        UsageError: it is longer than an archive may be.
        OSError, EOFError, lzma.LZMAError: its bytes are not those that were compressed.
    """
    left = _most_bytes(archive)
    while chunk := content.read(MAX_HEADER_BYTES):
        left -= len(chunk)
        if left < 0:
            raise fault(archive, "goes on after its end; nothing was installed.")


class _Headers:
    """A stream that gives no more than `MAX_HEADER_BYTES` at once: headers state their own length."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._read = stream.read
        self.seek = stream.seek
        self.tell = stream.tell

    def read(self, size: int = -1) -> bytes:
        """As of any stream.

        Raises:
            ValueError: more is asked for.
        """
        if not 0 <= size <= MAX_HEADER_BYTES:
            raise ValueError(f"a header of {size:,} bytes")
        return self._read(size)


def _zip_members(file: zipfile.ZipFile, archive: Path) -> Iterator[Member]:
    for info in file.infolist():
        # A link could lead out of the folder for the files after it.
        if (info.external_attr >> 16) & 0o170000 == _LINK:
            raise _refused(archive, info.filename, "a link")
        if info.flag_bits & 1:
            raise _refused(archive, info.filename, "encrypted")
        if not info.is_dir():
            yield info.filename, info.file_size, lambda info=info: file.open(info)


def _tar_members(content: IO[bytes], archive: Path) -> Iterator[Member]:
    file = tarfile.TarFile(fileobj=cast(IO[bytes], _Headers(content)))
    # One after the other: the sizes so far are known before the next header is unpacked.
    for info in file:
        if not (info.isfile() or info.isdir()):
            raise _refused(archive, info.name, "a link or a device")
        if info.isfile():
            yield (
                info.name,
                info.size,
                lambda info=info: cast(IO[bytes], file.extractfile(info)),
            )


def _refused(archive: Path, name: str, kind: str) -> UsageError:
    return fault(archive, f"{name!r} is {kind}; nothing was installed.")


def _most_bytes(archive: Path) -> float:
    """Most bytes that an archive may hold: a small file can hold any number."""
    return min(
        MAX_UNPACKED_BYTES, LEAST_UNPACKED_BYTES + MAX_RATIO * archive.stat().st_size
    )


def _write(members: Iterator[Member], folder: Path, archive: Path) -> None:
    found: list[Member] = []
    wanted = 0
    most = _most_bytes(archive)
    for path, size, content in members:
        # All names and sizes are checked before anything is written.
        found.append((safe_path(path, str(archive)), size, content))
        wanted += size
        if wanted > most:
            raise fault(
                archive,
                f"holds more than {most / 1e9:.1f} GB, which no data set of its size does; nothing was installed.",
            )
    folder.mkdir(parents=True, exist_ok=True)
    # Asked before the first file is written: a full disk would stop other programs, too.
    free = shutil.disk_usage(folder).free
    if wanted > free:
        raise fault(
            archive,
            f"holds {wanted / 1e9:.1f} GB, but {folder} has only {free / 1e9:.1f} GB free.",
        )
    for path, _, content in found:
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with content() as source, target.open("wb") as file:
            shutil.copyfileobj(source, file)
