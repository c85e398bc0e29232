"""Where files live: things that can be made again (compiled homes, settled starts), and downloaded data sets."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable
from pathlib import Path


def cache_dir() -> Path:
    """Folder of cached files: ``$MJHAB_CACHE``, else ``$XDG_CACHE_HOME/mjhab``, else ``~/.cache/mjhab``."""
    given = os.environ.get("MJHAB_CACHE")
    if given:
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "mjhab"


def assets_dir() -> Path:
    """Folder of downloaded data sets: ``$MJHAB_ASSETS``, else ``$XDG_DATA_HOME/mjhab/assets``, else in ``~/.local``."""
    given = os.environ.get("MJHAB_ASSETS")
    if given:
        return Path(given)
    base = os.environ.get("XDG_DATA_HOME")
    return (Path(base) if base else Path.home() / ".local" / "share") / "mjhab" / "assets"


def write_atomic(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then rename it into place.

    A reader sees the old file or the new one, never half of one, also when two processes write at once.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Not mkstemp: the file keeps the permissions that the user's umask gives to new files.
    temporary = path.with_name(f".{path.stem}-{os.getpid()}-{secrets.token_hex(4)}{path.suffix}")
    try:
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
