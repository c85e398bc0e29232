"""The folder of a run that can be resumed: one writer, one configuration, files that are whole or not there.

Evaluations, data sets, trainings, tables of the paper and benches have one each; a subclass says what its files are.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

from mjhab.core.errors import UsageError, wrong_value
from mjhab.core.files.cache import write_json, write_text
from mjhab.core.files.locking import WriteLock, lock_path, refuse_if_written
from mjhab.core.files.outputs import PROBE, check_output
from mjhab.core.files.reading import read_json_object

CONFIG = "config.json"
SUMMARY = "summary.json"
REPORT = "report.html"
_MOST_SHOWN_CHANGES = 5


class RunFolder:
    """A folder that is open for writing: nobody else can open it. Make one with `open`.

    Use as a context manager, or ``close`` it. A context that a `UsageError` ends before there is any work leaves
    nothing in the folder, so that the corrected command may use it.
    """

    CONFIG_FILE: ClassVar[str] = CONFIG
    """File with the configuration as JSON."""
    OWN: ClassVar[frozenset[str]] = frozenset()
    """Files that a run with ``overwrite`` deletes; none for runs that cannot be overwritten."""
    FREE_KEYS: ClassVar[frozenset[str]] = frozenset()
    """Keys of the configuration that a resumed run may change."""
    RESUMES: ClassVar[bool] = True
    """Whether its command has --resume; without it, the same command goes on by itself."""
    WORK: ClassVar[tuple[str, ...]] = ()
    """Patterns of files that cost time to make, at any depth; one without content does not count."""

    def __init__(self, path: Path, config: Mapping[str, Any], lock: WriteLock) -> None:
        self.path = path
        self.config: dict[str, Any] = dict(config)
        self._lock = lock
        self._is_new = False
        self._was_empty = False

    @classmethod
    def check(
        cls,
        path: Path,
        config: Mapping[str, Any],
        *,
        resume: bool = False,
        overwrite: bool = False,
    ) -> None:
        """Refuse what `open` cannot do, and change nothing: for checks before long preparations.

        Raises:
            UsageError: both switches; the folder holds something and neither switch is given; the folder to resume
                holds no run, or one with another config; another process is writing into it; ``path`` is a file.
        """
        if resume and overwrite:
            raise wrong_value("resume", True, "left out with overwrite")
        check_output(path)
        if path.exists() and not path.is_dir():
            raise wrong_value("out", str(path), "a folder, not a file")
        refuse_if_written(path / cls.CONFIG_FILE, path)
        cls._check_content(path, config, resume=resume, overwrite=overwrite)

    @classmethod
    def open(
        cls,
        path: Path,
        config: Mapping[str, Any],
        *,
        resume: bool = False,
        overwrite: bool = False,
    ) -> Self:
        """Prepare ``path`` for a run with ``config`` (plain JSON data) and save the config there.

        Args:
            path: the folder; made if missing.
            config: resolved options of the run.
            resume: continue a run that has the same config (``FREE_KEYS`` may differ).
            overwrite: delete what an earlier run left in the folder; files of others stay.

        Raises:
            UsageError: see `check`.
        """
        # Through JSON, so that it equals what a later start reads: tuples become lists there.
        config = json.loads(json.dumps(config))
        cls.check(path, config, resume=resume, overwrite=overwrite)
        is_new = not path.exists()
        path.mkdir(parents=True, exist_ok=True)
        lock = WriteLock(path / cls.CONFIG_FILE, path)
        try:
            # Another process may have been here between the check and the lock.
            cls._check_content(path, config, resume=resume, overwrite=overwrite)
            folder = cls(path, config, lock)
            folder._is_new = is_new
            folder._was_empty = not cls._content(path)
            if overwrite:
                folder._delete_own()
            elif resume:
                folder._take_up()
            write_json(path / cls.CONFIG_FILE, config, indent=2)
        # Also Ctrl-C: a lock that stays would refuse the next start.
        except BaseException:
            lock.release()
            raise
        return folder

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        refused = kind is not None and issubclass(kind, UsageError)
        # Results that cost hours are kept whatever was wrong.
        refused = refused and not self._has_work()
        if refused:
            self._delete_refused()
        self.close()
        # Only a folder that this start has made, and nobody else has used meanwhile.
        if refused and self._is_new and not any(self.path.iterdir()):
            self.path.rmdir()

    def close(self) -> None:
        """Let others write into the folder; closing twice is fine."""
        self._lock.release()

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write summary.json in one piece."""
        write_json(self.path / SUMMARY, summary, indent=2)

    def write_report(self, html: str) -> Path:
        """Write report.html in one piece and return its path."""
        write_text(self.path / REPORT, html)
        return self.path / REPORT

    def _take_up(self) -> None:
        """Read what earlier starts have left in a folder that is resumed."""

    def _has_work(self) -> bool:
        return any(
            # A file that was opened and never written holds no work.
            file.stat().st_size > 0
            for pattern in self.WORK
            for file in self.path.rglob(pattern)
        )

    def _delete_own(self) -> None:
        """Delete the files of a run; those of others stay."""
        for name in self.OWN:
            (self.path / name).unlink(missing_ok=True)

    def _delete_refused(self) -> None:
        """Delete what this start has put into the folder."""
        self._delete_own()
        # In a folder that held something, what is new cannot be told from what was there.
        for name in self._content(self.path) if self._was_empty else ():
            entry = self.path / name
            if entry.is_dir():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink(missing_ok=True)

    @classmethod
    def _content(cls, path: Path) -> list[str]:
        """Names of what lies in a folder, apart from the lock, and from what another process tries to write there."""
        own = lock_path(path / cls.CONFIG_FILE).name
        names = sorted(entry.name for entry in path.iterdir())
        return [name for name in names if name != own and not name.startswith(PROBE)]

    @classmethod
    def _check_content(
        cls, path: Path, config: Mapping[str, Any], *, resume: bool, overwrite: bool
    ) -> None:
        found = cls._content(path) if path.exists() else []
        # Runs whose files are not known by name cannot be overwritten safely.
        again = "--overwrite to start it again, " if cls.OWN else ""
        resuming = f"Give --resume to continue that run, {again}or another --out."
        if found and not (resume or overwrite):
            raise wrong_value(
                "out",
                str(path),
                f"empty, but holds {_some(found)}",
                resuming if cls.RESUMES else "Give another --out.",
            )
        if found and resume:
            cls._check_same(path, json.loads(json.dumps(config)))

    @classmethod
    def _as_begun_now(
        cls, old: Mapping[str, Any], config: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        """What the run in the folder is compared as with the ``config`` to resume it with; ``old`` is what it has.

        Raises:
            UsageError: the run cannot be resumed with it.
        """
        return old

    @classmethod
    def _check_same(cls, path: Path, config: Mapping[str, Any]) -> None:
        """Refuse to resume a folder of another run.

        Raises:
            UsageError: names the differences, the version of mjhab among them.
        """
        if not (path / cls.CONFIG_FILE).is_file():
            raise wrong_value(
                "resume",
                str(path),
                f"a folder with {cls.CONFIG_FILE}",
                "There is nothing to resume. Give an empty or new folder as --out.",
            )
        try:
            old = read_json_object(path / cls.CONFIG_FILE)
        except UsageError as error:
            remedy = "Use --overwrite." if cls.OWN else "Give another --out."
            raise UsageError(f"cannot resume: {error} {remedy}") from error
        old = cls._as_begun_now(old, config)
        changes = [
            change
            # Keys of both: an option that only one version has is a difference, too.
            for key in sorted({*old, *config} - cls.FREE_KEYS)
            for change in _changes(key, old.get(key), config.get(key))
        ]
        if changes:
            remedies = (
                "or --overwrite, or another --out" if cls.OWN else "or another --out"
            )
            raise UsageError(
                f"cannot resume {path}: it was started with {_changes_text(changes)}. Use the same options, {remedies}."
            )


def _some(names: list[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


def _changes_text(changes: list[tuple[str, Any, Any]]) -> str:
    told = "; ".join(
        f"{name} = {before!r}, now it is {now!r}"
        for name, before, now in changes[:_MOST_SHOWN_CHANGES]
    )
    more = len(changes) - _MOST_SHOWN_CHANGES
    return f"{told}; and {more} more" if more > 0 else told


def _changes(name: str, old: Any, new: Any) -> list[tuple[str, Any, Any]]:
    """Name, old and new value of everything that differs; objects are compared entry by entry, as NAME.ENTRY."""
    if isinstance(old, dict) and isinstance(new, dict):
        return [
            change
            for key in sorted({*old, *new})
            for change in _changes(f"{name}.{key}", old.get(key), new.get(key))
        ]
    return [(name, old, new)] if old != new else []
