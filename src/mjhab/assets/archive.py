"""Unpack archives that somebody else made: nothing may land outside the folder."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import shutil
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import IO, cast

from mjhab.core.errors import UsageError

_LINK = 0o120000
MAX_UNPACKED_BYTES = 50e9
LEAST_UNPACKED_BYTES = 1e9
MAX_RATIO = 50
"""Limits of an archive's content, in all and times its own size above the least; data sets have a ratio below 10."""
MAX_HEADER_BYTES = 2**20
"""Longest header of a file in a tar archive."""


def safe_path(path: str, where: str) -> str:
    """A relative path that stays below its folder on every system, without ``.`` parts.

    Raises:
        UsageError: it is absolute, climbs out with ``..``, or uses what some system takes for a drive or separator.
    """
    parts = [part for part in PurePosixPath(path).parts if part != "."]
    bad = (
        path.startswith("/")
        or ".." in parts
        or "\\" in path
        or ":" in path
        or "\0" in path
    )
    if bad or not parts:
        raise UsageError(
            f"{where}: the path {path!r} leads out of the folder; nothing was installed."
        )
    return "/".join(parts)


def unpack(
    archive: Path, folder: Path, tell: Callable[[int], object] = lambda count: None
) -> None:
    """Write the files of a zip or tar archive into ``folder``.

    Args:
        archive: the archive.
        folder: made if missing.
        tell: called with the number of bytes written.

    Raises:
        UsageError: it is no archive, it is damaged, or it holds links, devices or paths that lead out of the folder.
    """
    try:
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as file:
                _write(_zip_members(file, archive), folder, archive, tell)
        else:
            with _plain(archive) as content, _opened_tar(archive, content) as file:
                _write(_tar_members(file, archive), folder, archive, tell)
                _read_to_end(content, archive)
    except gzip.BadGzipFile as error:
        raise _damaged(archive, error) from error
    except OSError as error:
        # That of bz2 for damaged data has no number, those of the system have one.
        if error.errno is None:
            raise _damaged(archive, error) from error
        raise
    except (
        zipfile.BadZipFile,
        tarfile.TarError,
        EOFError,
        zlib.error,
        lzma.LZMAError,
        NotImplementedError,
        ValueError,
    ) as error:
        raise _damaged(archive, error) from error


def _damaged(archive: Path, error: Exception) -> UsageError:
    return UsageError(f"{archive}: damaged ({error}); nothing was installed.")


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
            raise UsageError(f"{archive}: goes on after its end; nothing was installed.")


def _opened_tar(archive: Path, content: IO[bytes]) -> tarfile.TarFile:
    """The tar archive that a stream holds.

    Raises:
        UsageError: it holds none.
    """
    try:
        return tarfile.open(fileobj=_Headers(content), mode="r:")
    except (tarfile.ReadError, OSError, EOFError) as error:
        raise UsageError(f"{archive}: neither a zip nor a tar archive.") from error


def _plain(archive: Path) -> IO[bytes]:
    """A tar archive without its compression."""
    with archive.open("rb") as file:
        begin = file.read(max(map(len, _COMPRESSED)))
    for magic, opened in _COMPRESSED.items():
        if begin.startswith(magic):
            return cast(IO[bytes], opened(archive))
    return archive.open("rb")


_COMPRESSED: dict[bytes, Callable[[Path], object]] = {
    b"\x1f\x8b": gzip.GzipFile,
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ": lzma.LZMAFile,
}
"""What reads an archive that begins with these bytes."""


class _Headers(io.RawIOBase):
    """A stream that gives no more than `MAX_HEADER_BYTES` at once: headers state their own length."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream

    def read(self, size: int = -1, /) -> bytes:
        """As of any stream.

        Raises:
            ValueError: more is asked for.
        """
        if not 0 <= size <= MAX_HEADER_BYTES:
            raise ValueError(f"a header of {size:,} bytes")
        return self._stream.read(size)

    def seek(self, offset: int, whence: int = 0, /) -> int:
        """As of any stream."""
        return self._stream.seek(offset, whence)

    def tell(self) -> int:
        """As of any stream."""
        return self._stream.tell()

    def seekable(self) -> bool:
        """It is."""
        return True


Member = tuple[str, int, Callable[[], IO[bytes]]]
"""Path, size [bytes], and what opens it."""


def _zip_members(file: zipfile.ZipFile, archive: Path) -> Iterator[Member]:
    for info in file.infolist():
        if (info.external_attr >> 16) & 0o170000 == _LINK:
            raise UsageError(
                f"{archive}: {info.filename!r} is a link; nothing was installed."
            )
        if info.flag_bits & 1:
            raise UsageError(
                f"{archive}: {info.filename!r} is encrypted; nothing was installed."
            )
        if not info.is_dir():
            yield info.filename, info.file_size, lambda info=info: file.open(info)


def _tar_members(file: tarfile.TarFile, archive: Path) -> Iterator[Member]:
    # One after the other: the sizes so far are known before the next header is unpacked.
    for info in file:
        if not (info.isfile() or info.isdir()):
            raise UsageError(
                f"{archive}: {info.name!r} is a link or a device; nothing was installed."
            )
        if info.isfile():
            yield info.name, info.size, lambda info=info: _open(file, info)


def _open(file: tarfile.TarFile, info: tarfile.TarInfo) -> IO[bytes]:
    content = file.extractfile(info)
    assert content is not None
    return content


def _most_bytes(archive: Path) -> float:
    """Most bytes that an archive may hold: a small file can hold any number."""
    return min(
        MAX_UNPACKED_BYTES, LEAST_UNPACKED_BYTES + MAX_RATIO * archive.stat().st_size
    )


def _write(
    members: Iterator[Member], folder: Path, archive: Path, tell: Callable[[int], object]
) -> None:
    found: list[Member] = []
    wanted = 0
    most = _most_bytes(archive)
    for path, size, content in members:
        found.append((safe_path(path, str(archive)), size, content))
        wanted += size
        if wanted > most:
            raise UsageError(
                f"{archive}: holds more than {most / 1e9:.1f} GB, which no data set of its size does; nothing was "
                "installed."
            )
    folder.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(folder).free
    if wanted > free:
        raise UsageError(
            f"{archive}: holds {wanted / 1e9:.1f} GB, but {folder} has only {free / 1e9:.1f} GB free."
        )
    for path, size, content in found:
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with content() as source, target.open("wb") as file:
            shutil.copyfileobj(source, file)
        tell(size)
