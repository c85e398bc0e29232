"""Where files live: things that can be made again (compiled homes, settled starts), and downloaded data sets."""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import secrets
import shutil
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from mjhab.core.errors import MjhabError, UsageError
from mjhab.core.files.outputs import naming_file
from mjhab.core.progress import say

CACHE_VARIABLE = "MJHAB_CACHE"
"""Environment variable with the folder of cached files."""
_MANY_FILES = "episodes"
"""Folder of the cache with too many files to link, which are quickly made again."""
_USABLE: set[Path] = set()
_DAMAGED = (OSError, ValueError, TypeError, KeyError, EOFError, zipfile.BadZipFile)
"""What readers of JSON, npz and compiled models raise for a file that is not whole."""
Content = TypeVar("Content")


def cache_dir() -> Path:
    """Folder of cached files: ``$MJHAB_CACHE``, else the user's cache folder of the system.

    That is ``$XDG_CACHE_HOME/mjhab`` or ``~/.cache/mjhab`` on Linux.
    Where that cannot be written, a temporary folder that lasts as long as this process, after one warning.

    Raises:
        MjhabError: there is no room for temporary files either.
    """
    wanted = _wanted_dir()
    if wanted not in _USABLE:
        try:
            wanted.mkdir(parents=True, exist_ok=True)
            # Tried by doing: permissions say nothing of read-only disks and full quotas.
            os.rmdir(tempfile.mkdtemp(prefix=".mjhab-", dir=wanted))
        except (OSError, ValueError) as error:
            wanted = _temporary_dir(wanted, error)
        # Once per folder and process: the test writes to the disk.
        _USABLE.add(wanted)
    return wanted


def _wanted_dir() -> Path:
    """The folder that the user wants; that of a user who has no home cannot be made."""
    given = os.environ.get(CACHE_VARIABLE)
    if given:
        return Path(given)
    import platformdirs  # a few ms, for nothing where the variable names a folder

    try:
        return platformdirs.user_cache_path(_APP, appauthor=False)
    except RuntimeError:
        return _NO_HOME / _APP


_APP = "mjhab"
_NO_HOME = Path(os.devnull)
"""Takes the place of a home that is not there: nothing can be made below it."""


def _temporary_dir(wanted: Path, error: Exception) -> Path:
    """From now on cache in a temporary folder, with links to the files that lie in ``wanted``."""
    reason = getattr(error, "strerror", None) or error
    try:
        folder = Path(tempfile.mkdtemp(prefix="mjhab-cache-"))
    except OSError as full:
        raise MjhabError(
            f"neither the cache {wanted} ({reason}) nor a temporary folder ({full.strerror}) can be written. Give a "
            f"folder with room for a few hundred MB by ${CACHE_VARIABLE}."
        ) from full
    # With the number of this process: forked ones inherit the handler and would delete the folder of their parent.
    atexit.register(_delete_own, folder, os.getpid())
    # The temporary folder does without: all of it can be made again.
    with contextlib.suppress(OSError):
        for room in wanted.iterdir():
            if room.is_dir() and room.name != _MANY_FILES:
                # Links, so that what is already compiled is neither copied nor compiled again.
                shutil.copytree(room, folder / room.name, copy_function=os.symlink)
    cause = f"the cache {wanted} cannot be written ({reason})"
    if wanted.is_relative_to(_NO_HOME):
        cause = "this user has no home folder for the cache"
    say(
        f"mjhab: {cause}; what is compiled now is lost when this process ends. "
        f"${CACHE_VARIABLE} chooses another folder."
    )
    # Processes that this one starts share the folder.
    os.environ[CACHE_VARIABLE] = str(folder)
    return folder


def _delete_own(folder: Path, process: int) -> None:
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)


def write_cached(path: Path, write: Callable[[Path], object]) -> Path:
    """`write_atomic` for a file below `cache_dir`; in the temporary one if the disk is full.

    Returns:
        Where the file lies now.

    Raises:
        MjhabError: there is no room for temporary files either.
    """
    try:
        write_atomic(path, write)
        return path
    except OSError as error:
        root = next(folder for folder in _USABLE if path.is_relative_to(folder))
        moved = _temporary_dir(root, error) / path.relative_to(root)
        # The variable names the temporary folder by now, which needs no test.
        _USABLE.add(_wanted_dir())
        try:
            write_atomic(moved, write)
        except OSError as full:
            raise MjhabError(
                f"{moved} cannot be written ({full.strerror or full})."
            ) from full
        return moved


def read_cached(path: Path, read: Callable[[Path], Content]) -> Content | None:
    """Return what ``read`` makes of a cached file; None if it is not there or damaged, so that it is made again.

    A file may be cut or full of zeros after a crash of the machine, or where a cache was copied in part.
    """
    try:
        return read(path)
    except _DAMAGED:
        return None


def assets_dir() -> Path:
    """Folder of downloaded data sets: ``$MJHAB_ASSETS``, else the user's data folder of the system.

    That is ``$XDG_DATA_HOME/mjhab/assets`` or ``~/.local/share/mjhab/assets`` on Linux.

    Raises:
        UsageError: the user has no home.
    """
    given = os.environ.get("MJHAB_ASSETS")
    if given:
        return Path(given)
    import platformdirs

    try:
        return platformdirs.user_data_path(_APP, appauthor=False) / "assets"
    except RuntimeError as error:
        raise UsageError(
            "this user has no home folder; name a folder for data sets by $MJHAB_ASSETS."
        ) from error


def write_atomic(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then rename it into place.

    A reader sees the old file or the new one, never half of one, also when two processes write at once.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Not mkstemp: the file keeps the permissions that the user's umask gives to new files.
    temporary = path.with_name(
        f".{path.stem}-{os.getpid()}-{secrets.token_hex(4)}{path.suffix}"
    )
    try:
        with naming_file(path):
            write(temporary)
        # Not rename, which fails on Windows where the file exists.
        os.replace(temporary, path)
    finally:
        # Also after an interruption: nobody else would ever delete it.
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` in UTF-8 so that a reader sees the old file or the new one, never a part."""
    write_atomic(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_json(path: Path, value: Any, indent: int = 1) -> None:
    """Write JSON data as `write_text` does, with an end of line."""
    write_text(path, json.dumps(value, indent=indent) + "\n")
