"""A folder that appears whole or not at all, and that another process can go on to fill when one was stopped."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjhab.core.errors import MjhabError, UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.locking import WriteLock
from mjhab.core.files.reading import read_json_object
from mjhab.core.version import __version__
from mjhab.data.store.shard import StorageError, is_full

JOB = "job.json"
WHOLE = "whole"
WORK = "work"
"""What lies in ``.<name>.part``: what is being made, what it is to become, and what is needed on the way."""


@dataclass(frozen=True)
class Filling:
    """A folder that is being filled. ``root``: what appears in the end; ``work``: for what is not part of it."""

    root: Path
    work: Path


@dataclass(frozen=True)
class Target:
    """Where a folder is to appear.

    out: its name. overwrite: it may take the place of one in which something fits the pattern ``mark``. resume: go on
    with what a stopped process has left.
    """

    out: Path
    mark: str
    overwrite: bool = False
    resume: bool = False

    @property
    def part(self) -> Path:
        """The folder that is filled."""
        return self.out.with_name(f".{self.out.name}.part")

    @property
    def old(self) -> Path:
        """Where the one that is replaced stays until the new one has its name."""
        return self.out.with_name(f".{self.out.name}.old")

    @property
    def begun(self) -> bool:
        """Whether a stopped process has left something to go on with."""
        return (self.part / JOB).is_file() and (self.part / WHOLE).is_dir()


@contextmanager
def whole_folder(target: Target, job: Mapping[str, Any]) -> Iterator[Filling]:
    """Give a folder beside ``target.out`` to fill; without an error ``root`` takes that name at the end.

    What was filled stays when the process is stopped or killed, or the disk is full, for a later one with ``resume``.
    A folder that is replaced stays until the new one is complete.

    Args:
        job: plain data that decides what is made; that of a resumed one must be equal, as must the version of mjhab.

    Raises:
        UsageError: ``out`` exists and may not be overwritten; something was begun that is not to be gone on with, or
            is another job; or another process is filling it. One that is raised inside leaves nothing.
        StorageError: the disk is full or broken.
    """
    target.out.parent.mkdir(parents=True, exist_ok=True)
    lock = WriteLock(target.out, target.out)
    try:
        if target.old.exists() and not target.out.exists():
            os.replace(target.old, target.out)
        plain = json.loads(json.dumps({**job, "mjhab": __version__}))
        _check(target, plain)
        try:
            yield _begin(target, plain)
            _publish(target)
        except UsageError:
            shutil.rmtree(target.part, ignore_errors=True)
            raise
        except (OSError, MjhabError) as error:
            # ffmpeg says in words of its own that the disk is full.
            if isinstance(error, OSError) or is_full(error):
                raise _stopped(target.out, error) from error
            raise
    finally:
        lock.release()


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """How the job that a folder was begun with differs from another one, in words; empty if it does not."""
    other = sorted(key for key in {*before, *now} if before.get(key) != now.get(key))
    values = "; ".join(f"{key}: {before.get(key)!r}, now {now.get(key)!r}" for key in other)
    return f"{', '.join(other)} ({values})" if other else ""


def broken(out: Path, error: Exception) -> StorageError:
    """The error for something that is written as a whole and could not be."""
    if is_full(error):
        return StorageError(
            f"cannot write {out}: the disk is full. Nothing of it was left; free some space and give the same command "
            "again."
        )
    return StorageError(
        f"cannot write {out}: {_reason(error)}. Give the same command again when that is mended."
    )


def _stopped(out: Path, error: Exception) -> StorageError:
    what, then = (
        ("the disk is full", "free some space") if is_full(error) else (_reason(error), "mend that")
    )
    return StorageError(
        f"cannot write {out}: {what}. What is done stays beside it; {then} and give the same command with --resume."
    )


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def _begin(target: Target, job: dict[str, Any]) -> Filling:
    """The folder to fill: the one that was begun, or a new one."""
    part = target.part
    if not (target.begun and target.resume):
        for left in (part, target.old):
            shutil.rmtree(left, ignore_errors=True)
        for folder in (WHOLE, WORK):
            (part / folder).mkdir(parents=True)
        text = json.dumps(job, indent=2) + "\n"
        write_atomic(part / JOB, lambda path: path.write_text(text, encoding="utf-8"))
    return Filling(part / WHOLE, part / WORK)


def _publish(target: Target) -> None:
    if target.out.exists():
        os.replace(target.out, target.old)
    os.replace(target.part / WHOLE, target.out)
    for left in (target.old, target.part):
        shutil.rmtree(left, ignore_errors=True)


def _check(target: Target, job: dict[str, Any]) -> None:
    out = target.out
    if out.exists():
        if not out.is_dir():
            raise UsageError(f"{out} is a file; name a folder as --out.")
        if not target.overwrite:
            raise UsageError(
                f"{out} exists already; name another folder as --out, or give --overwrite."
            )
        if any(out.iterdir()) and not any(out.glob(target.mark)):
            raise UsageError(
                f"{out} holds something else than an export (no {target.mark}), so it is not overwritten."
            )
    if not target.begun:
        return
    if target.resume:
        other = differences(read_json_object(target.part / JOB), job)
        if other:
            raise UsageError(
                f"the export to {out} was begun with another {other}. Give the same options and episodes, or "
                "--overwrite without --resume to begin anew."
            )
    elif not target.overwrite:
        raise UsageError(
            f"an export to {out} was begun and stopped; add --resume to go on with it, or --overwrite to begin anew."
        )
