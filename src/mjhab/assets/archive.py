"""Unpack archives that somebody else made: nothing may land outside the folder."""

from __future__ import annotations

import lzma
import shutil
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import IO

from mjhab.core.errors import UsageError

_LINK = 0o120000


def safe_path(path: str, where: str) -> str:
    """A relative path that stays below its folder on every system, without ``.`` parts.

    Raises:
        UsageError: it is absolute, climbs out with ``..``, or uses what some system takes for a drive or separator.
    """
    parts = [part for part in PurePosixPath(path).parts if part != "."]
    bad = path.startswith("/") or ".." in parts or "\\" in path or ":" in path or "\0" in path
    if bad or not parts:
        raise UsageError(
            f"{where}: the path {path!r} leads out of the folder; nothing was installed."
        )
    return "/".join(parts)


def unpack(archive: Path, folder: Path, tell: Callable[[int], object] = lambda count: None) -> None:
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
        elif tarfile.is_tarfile(archive):
            with tarfile.open(archive) as file:
                _write(_tar_members(file, archive), folder, archive, tell)
        else:
            raise UsageError(f"{archive}: neither a zip nor a tar archive.")
    except (
        zipfile.BadZipFile,
        tarfile.TarError,
        EOFError,
        zlib.error,
        lzma.LZMAError,
        NotImplementedError,
    ) as error:
        raise UsageError(f"{archive}: damaged ({error}); nothing was installed.") from error


Member = tuple[str, int, Callable[[], IO[bytes]]]
"""Path, size [bytes], and what opens it."""


def _zip_members(file: zipfile.ZipFile, archive: Path) -> Iterator[Member]:
    for info in file.infolist():
        if (info.external_attr >> 16) & 0o170000 == _LINK:
            raise UsageError(f"{archive}: {info.filename!r} is a link; nothing was installed.")
        if info.flag_bits & 1:
            raise UsageError(f"{archive}: {info.filename!r} is encrypted; nothing was installed.")
        if not info.is_dir():
            yield info.filename, info.file_size, lambda info=info: file.open(info)


def _tar_members(file: tarfile.TarFile, archive: Path) -> Iterator[Member]:
    for info in file.getmembers():
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


def _write(
    members: Iterator[Member], folder: Path, archive: Path, tell: Callable[[int], object]
) -> None:
    found = [(safe_path(path, str(archive)), size, content) for path, size, content in members]
    folder.mkdir(parents=True, exist_ok=True)
    wanted = sum(size for _, size, _ in found)
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
