"""A folder that is written atomically, and that a later process can complete after an interruption."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjhab.core.errors import MjhabError, UsageError, fault, wrong_value
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.locking import WriteLock
from mjhab.core.files.outputs import differences
from mjhab.core.files.reading import read_json_object
from mjhab.core.version import __version__
from mjhab.data.store.storage import StorageError, is_full, reason_of

JOB = "job.json"
WHOLE = "whole"
WORK = "work"
"""Content of the temporary folder ``.<name>.part``: description of the job, the future folder, and work files."""


@dataclass(frozen=True)
class StagingDir:
    """A folder that is being filled. root: becomes the final folder. work: for temporary files."""

    root: Path
    work: Path


@dataclass(frozen=True)
class ExportTarget:
    """The folder to write.

    out: its path. foreign: tells why a folder is not an export of this kind, "" if it is one. overwrite: replace an
    existing export. resume: continue what an interrupted process has left.

    Raises:
        UsageError: ``out`` has no name of its own ("." or "/"), so that no folder beside it can be named after it.
    """

    out: Path
    foreign: Callable[[Path], str]
    overwrite: bool = False
    resume: bool = False

    def __post_init__(self) -> None:
        # The temporary names are made from it, and ".." has no folder beside it.
        if self.out.name in ("", ".."):
            raise wrong_value(
                "out",
                str(self.out),
                f"the name of a new folder, such as {self.out / 'export'}",
            )

    @property
    def part(self) -> Path:
        """The temporary folder that is filled."""
        # Beside the target, so that the rename stays on one file system.
        return self.out.with_name(f".{self.out.name}.part")

    @property
    def old(self) -> Path:
        """Temporary name of the replaced folder until the new one is in place."""
        return self.out.with_name(f".{self.out.name}.old")

    @property
    def begun(self) -> bool:
        """Whether an interrupted process has left something to continue."""
        return (self.part / JOB).is_file() and (self.part / WHOLE).is_dir()


@contextmanager
def whole_folder(target: ExportTarget, job: Mapping[str, Any]) -> Iterator[StagingDir]:
    """Context manager that yields a temporary folder to fill; on success it is renamed to ``target.out``.

    If the process is interrupted or killed, or the disk is full, the files stay for a later call with ``resume``.
    A replaced folder stays until the new one is complete.

    Args:
        target: the folder to write.
        job: JSON data that determines the content. A resumed job and its version of mjhab must be equal.

    Raises:
        UsageError: ``out`` exists and may not be overwritten; an unfinished folder exists and ``resume`` is not set,
            or it belongs to another job; or another process is filling it. If the body of the context raises a
            UsageError, the temporary folder is deleted.
        StorageError: the disk is full or broken.
    """
    target.out.parent.mkdir(parents=True, exist_ok=True)
    with WriteLock(target.out, target.out):
        # A process died between the two renames of `_publish`; the old folder is the only whole one.
        if target.old.exists() and not target.out.exists():
            os.replace(target.old, target.out)
        # Tuples become lists, as they will read back from the file that they are compared with.
        plain = json.loads(json.dumps({**job, "mjhab": __version__}))
        _check(target, plain)
        try:
            yield _begin(target, plain)
            _publish(target)
        except UsageError:
            # A refused request fails again with the same parts: they are of no use to --resume.
            shutil.rmtree(target.part, ignore_errors=True)
            raise
        except (OSError, MjhabError) as error:
            # ffmpeg reports a full disk only in the text of its error.
            if isinstance(error, OSError) or is_full(error):
                raise _stopped(target.out, error) from error
            raise


def _stopped(out: Path, error: Exception) -> StorageError:
    fix = "free some space" if is_full(error) else "fix that"
    return StorageError(
        f"cannot write {out}: {reason_of(error)}. Finished parts are kept; {fix} and run the same command with "
        "--resume."
    )


def _begin(target: ExportTarget, job: dict[str, Any]) -> StagingDir:
    """The folder to fill: the unfinished one, or a new one."""
    part = target.part
    if not (target.begun and target.resume):
        for left in (part, target.old):
            shutil.rmtree(left, ignore_errors=True)
        for folder in (WHOLE, WORK):
            (part / folder).mkdir(parents=True)
        text = json.dumps(job, indent=2) + "\n"
        # After the folders, because its presence says that there is something to continue.
        write_atomic(part / JOB, lambda path: path.write_text(text, encoding="utf-8"))
    return StagingDir(part / WHOLE, part / WORK)


def _publish(target: ExportTarget) -> None:
    if target.out.exists():
        # A folder with files cannot be replaced by rename, so the old one steps aside first.
        os.replace(target.out, target.old)
    os.replace(target.part / WHOLE, target.out)
    for left in (target.old, target.part):
        shutil.rmtree(left, ignore_errors=True)


def _check(target: ExportTarget, job: dict[str, Any]) -> None:
    out = target.out
    if out.exists():
        if not out.is_dir():
            raise fault(out, "a file; name a folder as --out.")
        if not target.overwrite:
            raise fault(
                out, "exists already; name another folder as --out, or give --overwrite."
            )
        # An empty folder is nobody's data.
        foreign = target.foreign(out) if any(out.iterdir()) else ""
        if foreign:
            raise fault(
                out, f"does not hold an export ({foreign}), so it is not overwritten."
            )
    if not target.begun:
        return
    if target.resume:
        other = differences(read_json_object(target.part / JOB), job)
        if other:
            raise fault(
                f"unfinished export to {out}",
                f"has another {other}. Give the same options and episodes, or "
                "--overwrite without --resume to start again.",
            )
    elif not target.overwrite:
        raise UsageError(
            f"an export to {out} is unfinished; add --resume to continue it, or --overwrite to start again."
        )
