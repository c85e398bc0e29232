"""Places that commands write to, looked at before the work begins."""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mjhab.core.errors import shown, wrong_value
from mjhab.core.files.reading import reason

DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""What the system says of a full or broken disk."""
PROBE = ".mjhab-"
"""How the names of folders begin that are made and deleted at once, to see whether that is possible."""


@contextlib.contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Add the name of the file that is written to errors that lack it: a full disk names none.

    Args:
        path: the file, as the user knows it.
    """
    try:
        yield
    except OSError as error:
        # Errors of write and flush carry the number of a file at most.
        if error.filename is None:
            error.filename = str(path)
        raise


def check_output(path: Path, option: str = "--out") -> None:
    """Refuse a file or folder that cannot be written because of where it would lie; leaves nothing behind.

    Args:
        path: the file or folder; neither it nor the folders above it need to exist.
        option: what the user gave it by, for the message.

    Raises:
        UsageError: a name that the file system does not take, a file in place of a folder above it, or a folder that
            cannot be written.
    """
    try:
        # Links to nowhere, devices and pipes: writing beside and renaming would replace them.
        if os.path.lexists(path) and not (path.is_file() or path.is_dir()):
            raise OSError("it is neither a file nor a folder")
        _probe(path)
    except (OSError, ValueError) as error:
        raise wrong_value(
            option,
            str(path),
            f"a place that can be written ({reason(error)})",
            "Choose another.",
        ) from error


def check_file(path: Path, suffix: str, option: str = "--out") -> None:
    """Refuse a file of another kind than a command writes, so that a slip replaces no recorded data or results.

    Args:
        path: the file, which is replaced if it exists.
        suffix: what its name ends with, such as ".html".
        option: what the user gave it by, for the message.

    Raises:
        UsageError: it is a folder, or its name ends otherwise.
    """
    example = path.with_suffix(suffix)
    if path.is_dir():
        example = path / f"report{suffix}"
        raise wrong_value(
            option, str(path), f"a file such as {shown(str(example))}, not a folder"
        )
    if path.suffix.lower() != suffix:
        raise wrong_value(
            option,
            str(path),
            f"a name that ends with {suffix}, for instance {shown(str(example))}",
        )


def check_folder(path: Path, option: str = "--out") -> None:
    """Refuse a file in place of a folder that a command fills when its work is done.

    Args:
        path: the folder; it need not exist.
        option: what the user gave it by, for the message.

    Raises:
        UsageError: it is a file.
    """
    if path.is_file():
        raise wrong_value(option, str(path), "a folder, not a file")


def _probe(path: Path) -> None:
    """Make and delete a folder in the lowest folder at or above ``path`` that exists.

    Raises:
        OSError: that is not possible, or ``path`` can never be.
    """
    above = path
    new: list[str] = []
    while not above.is_dir():
        # lstat tells of a name that is too long and of a file in place of a folder; is_dir does not.
        with contextlib.suppress(FileNotFoundError):
            os.lstat(above)
        new.append(above.name)
        above = above.parent
    # A name below a folder that is not there yet is looked at by nobody else.
    longest = os.pathconf(above, "PC_NAME_MAX") if hasattr(os, "pathconf") else 255
    if any(len(os.fsencode(name)) > longest for name in new):
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
    os.rmdir(tempfile.mkdtemp(prefix=PROBE, dir=above))


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Describe how the options that a folder was begun with differ from the present ones; "" if they are equal."""
    other = sorted(key for key in {*before, *now} if before.get(key) != now.get(key))
    values = "; ".join(
        f"{key}: {before.get(key)!r}, now {now.get(key)!r}" for key in other
    )
    return f"{', '.join(other)} ({values})" if other else ""
