"""A folder that appears whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mjhab.core.errors import MjhabError, UsageError
from mjhab.data.locking import WriteLock
from mjhab.data.shard import StorageError, is_full


@contextmanager
def whole_folder(out: Path, mark: str, overwrite: bool) -> Iterator[Path]:
    """Give an empty folder beside ``out`` to fill; without an error it takes the name ``out`` at the end.

    What a killed process left is thrown away by the next one, so the same command can be given again. With
    ``overwrite`` the folder that was there stays until the new one is complete; only a folder in which something fits
    the pattern ``mark`` is taken for one that may go.

    Raises:
        UsageError: ``out`` exists and may not be overwritten, or another process is filling it.
        StorageError: the disk is full or broken; nothing is left of what was written.
    """
    part, old = (out.with_name(f".{out.name}.{word}") for word in ("part", "old"))
    out.parent.mkdir(parents=True, exist_ok=True)
    lock = WriteLock(out, out)
    try:
        if old.exists() and not out.exists():
            os.replace(old, out)
        _check(out, mark, overwrite)
        for left in (part, old):
            shutil.rmtree(left, ignore_errors=True)
        part.mkdir()
        yield part
        if out.exists():
            os.replace(out, old)
        os.replace(part, out)
        shutil.rmtree(old, ignore_errors=True)
    except (OSError, MjhabError) as error:
        # ffmpeg says in words of its own that the disk is full.
        if isinstance(error, OSError) or is_full(error):
            raise broken(out, error) from error
        raise
    finally:
        shutil.rmtree(part, ignore_errors=True)
        lock.release()


def broken(out: Path, error: Exception) -> StorageError:
    """The error for something that is written as a whole and could not be."""
    if is_full(error):
        return StorageError(
            f"cannot write {out}: the disk is full. Nothing of it was left; free some space and give the same command "
            "again."
        )
    what = getattr(error, "strerror", None) or str(error)
    return StorageError(f"cannot write {out}: {what}. Give the same command again when that is mended.")


def _check(out: Path, mark: str, overwrite: bool) -> None:
    if not out.exists():
        return
    if not out.is_dir():
        raise UsageError(f"{out} is a file; name a folder as --out.")
    if not overwrite:
        raise UsageError(f"{out} exists already; name another folder as --out, or give --overwrite.")
    if any(out.iterdir()) and not any(out.glob(mark)):
        raise UsageError(f"{out} holds something else than an export (no {mark}), so it is not overwritten.")
