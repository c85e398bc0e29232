"""The run folder: what survives a crash, Ctrl-C and a second start.

config.json      resolved options; a resumed run must match them
episodes.jsonl   one record per finished episode, flushed as it finishes
films/           films of the first episodes
summary.json     written at the end, also after Ctrl-C
report.html      likewise
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.locking import WriteLock, lock_path, refuse_if_written
from mjhab.core.files.outputs import check_output, naming_file
from mjhab.core.files.reading import parse_json, read_json_object, reason
from mjhab.rollout.indices import IndicesLeft
from mjhab.rollout.policy import RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink

CONFIG = "config.json"
EPISODES = "episodes.jsonl"
SUMMARY = "summary.json"
REPORT = "report.html"
FILMS = "films"
OWN = frozenset({CONFIG, EPISODES, SUMMARY, REPORT, FILMS})
_MOST_SHOWN_CHANGES = 5
FREE_KEYS = frozenset({"episodes", "films", "worlds", "threads"})
"""Config keys that a resumed run may change: they do not alter what happens in an episode."""


class RunFolder:
    """A run folder that is open for writing: nobody else can open it. Make one with ``RunFolder.open``.

    Use as a context manager, or ``close`` it. A context that a `UsageError` ends before the first record (a policy
    whose actions are none) leaves nothing in the folder.
    """

    def __init__(
        self,
        path: Path,
        config: Mapping[str, Any],
        records: list[EpisodeRecord],
        lock: WriteLock,
    ) -> None:
        self.path = path
        self.config = dict(config)
        self._hash = config_hash(config)
        self._records = {record.index: record for record in records}
        self._lock = lock
        self._is_new = False

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        refused = kind is not None and issubclass(kind, UsageError) and not self._records
        if refused:
            # So that the corrected command may use the folder.
            _delete_own(self.path)
        self.close()
        if refused and self._is_new and not any(self.path.iterdir()):
            self.path.rmdir()

    def close(self) -> None:
        """Let others write into the folder; closing twice is fine."""
        self._lock.release()

    @classmethod
    def open(
        cls,
        path: Path,
        config: Mapping[str, Any],
        *,
        resume: bool = False,
        overwrite: bool = False,
    ) -> RunFolder:
        """Prepare ``path`` for a run with ``config`` (plain JSON data) and save the config there.

        Args:
            path: the folder; made if missing.
            config: resolved options of the run.
            resume: continue a run that has the same config (``FREE_KEYS`` may differ).
            overwrite: delete what an earlier run left in the folder; files of others stay.

        Raises:
            UsageError: see ``check_folder``; or a record in the middle of the file is damaged or of another run.
        """
        config = json.loads(json.dumps(config))
        check_folder(path, config, resume=resume, overwrite=overwrite)
        is_new = not path.exists()
        path.mkdir(parents=True, exist_ok=True)
        lock = WriteLock(path / CONFIG, path)
        try:
            # Another process may have been here between the check and the lock.
            _check_content(path, config, resume=resume, overwrite=overwrite)
            records: list[EpisodeRecord] = []
            if overwrite:
                _delete_own(path)
            elif resume:
                records = _take_records(path / EPISODES, config_hash(config))
            write_text(path / CONFIG, json.dumps(config, indent=2) + "\n")
        except BaseException:
            lock.release()
            raise
        folder = cls(path, config, records, lock)
        folder._is_new = is_new
        return folder

    @property
    def records(self) -> list[EpisodeRecord]:
        """All finished episodes, of this start and of earlier ones, sorted by index."""
        return [self._records[index] for index in sorted(self._records)]

    def missing(self, episodes: int) -> IndicesLeft:
        """Indices below ``episodes`` that have no record yet."""
        return IndicesLeft(episodes, self._records)

    def add(self, record: EpisodeRecord) -> None:
        """Append a record to episodes.jsonl, with the hash of the config, and flush it to the system."""
        record = dataclasses.replace(record, config_hash=self._hash)
        path = self.path / EPISODES
        line = json.dumps(record.to_dict(), separators=(",", ":")) + "\n"
        with naming_file(path), path.open("a", encoding="utf-8") as file:
            file.write(line)
        self._records[record.index] = record

    def earlier_seconds(self) -> float:
        """Wall time [s] of the starts before this one, as far as they wrote a summary."""
        try:
            return float(self._earlier_summary().get("seconds", 0.0))
        except (TypeError, ValueError):
            return 0.0

    def earlier_requests(self, names: Sequence[str]) -> dict[str, Any]:
        """Those of the named entries, all maps, that the summary of the last start has."""
        summary = self._earlier_summary()
        return {
            name: summary[name] for name in names if isinstance(summary.get(name), dict)
        }

    def _earlier_summary(self) -> dict[str, Any]:
        """The summary of the last start; empty if there is none that can be read."""
        try:
            return read_json_object(self.path / SUMMARY)
        except UsageError:
            return {}

    def film_path(self, index: int) -> Path:
        """Where the film of an episode belongs."""
        return self.path / FILMS / f"episode_{index:05d}.mp4"

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write summary.json in one piece."""
        write_text(self.path / SUMMARY, json.dumps(summary, indent=2) + "\n")

    def write_report(self, html: str) -> Path:
        """Write report.html in one piece and return its path."""
        write_text(self.path / REPORT, html)
        return self.path / REPORT


class StoreSink(Sink[RolloutEnv]):
    """Puts every finished episode into the run folder at once."""

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder

    def on_episode_end(self, env: RolloutEnv, world: int, record: EpisodeRecord) -> None:
        """Append the record."""
        self._folder.add(record)


def check_folder(
    path: Path,
    config: Mapping[str, Any],
    *,
    resume: bool = False,
    overwrite: bool = False,
    replaceable: bool = True,
) -> None:
    """Refuse what ``RunFolder.open`` cannot do, and change nothing: for checks before long preparations.

    ``replaceable``: whether the caller's command has an option --overwrite that a message may advise.

    Raises:
        UsageError: both switches; the folder holds something and neither switch is given; the folder to resume
            holds no run, or one with another config; another process is writing into it; ``path`` is a file.
    """
    if resume and overwrite:
        raise UsageError("--resume and --overwrite exclude each other; give one of them.")
    check_output(path)
    if path.exists() and not path.is_dir():
        raise UsageError(f"the output path {path} is a file; give a folder.")
    refuse_if_written(path / CONFIG, path)
    _check_content(
        path, config, resume=resume, overwrite=overwrite, replaceable=replaceable
    )


def _check_content(
    path: Path,
    config: Mapping[str, Any],
    *,
    resume: bool,
    overwrite: bool,
    replaceable: bool = True,
) -> None:
    own_lock = lock_path(path / CONFIG).name
    found = (
        sorted(entry.name for entry in path.iterdir() if entry.name != own_lock)
        if path.exists()
        else []
    )
    if found and not (resume or overwrite):
        again = "--overwrite to start it again, " if replaceable else ""
        raise UsageError(
            f"the output folder {path} is not empty (it holds {_some(found)}). Give --resume to continue that run, "
            f"{again}or another --out."
        )
    if found and resume:
        _check_same(path, json.loads(json.dumps(config)), replaceable)


def read_records(folder: Path) -> list[EpisodeRecord]:
    """Return the finished episodes of a run folder, which may still be running; changes nothing.

    Raises:
        UsageError: a record that is not the last one is damaged, belongs to another config than the folder's, or names
            none (in a folder of an older version, no record names one); or an episode is there twice.
    """
    path = folder / EPISODES
    kept, _ = _read_file(path)
    hashed = any(record.config_hash for record in kept)
    _check_records(kept, _stored_hash(folder / CONFIG) if hashed else "", path)
    return kept


def config_hash(config: Mapping[str, Any]) -> str:
    """Name of a config: equal for configs that a resumed run may have, which differ in ``FREE_KEYS`` at most."""
    fixed = {
        key: value
        for key, value in config.items()
        if key not in FREE_KEYS and value is not None
    }
    text = json.dumps(fixed, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def write_text(path: Path, text: str) -> None:
    """Write ``text`` so that a reader sees the old file or the new one, never a part."""
    write_atomic(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (
        f" and {len(names) - 3} more" if len(names) > 3 else ""
    )


def _delete_own(path: Path) -> None:
    for name in OWN:
        entry = path / name
        if entry.is_dir():
            for film in (
                *entry.glob("episode_*.mp4*"),
                *entry.glob(".episode_*.part.mp4"),
            ):
                film.unlink()
            if not any(entry.iterdir()):
                entry.rmdir()
        else:
            entry.unlink(missing_ok=True)


def _check_same(path: Path, config: Mapping[str, Any], replaceable: bool) -> None:
    if not (path / CONFIG).is_file():
        raise UsageError(
            f"nothing to resume in {path}: it has no {CONFIG}. Give an empty or new folder as --out."
        )
    try:
        old = read_json_object(path / CONFIG)
    except UsageError as error:
        way = "Use --overwrite." if replaceable else "Give another --out."
        raise UsageError(f"cannot resume: {error} {way}") from error
    changes = [
        change
        for key in sorted({*old, *config} - FREE_KEYS)
        for change in _changes(key, old.get(key), config.get(key))
    ]
    if changes:
        told = "; ".join(
            f"{name} = {before!r}, now it is {now!r}"
            for name, before, now in changes[:_MOST_SHOWN_CHANGES]
        )
        more = len(changes) - _MOST_SHOWN_CHANGES
        told += f"; and {more} more" if more > 0 else ""
        ways = "or --overwrite, or another --out" if replaceable else "or another --out"
        raise UsageError(
            f"cannot resume {path}: it was started with {told}. Use the same options, {ways}."
        )


def _changes(name: str, old: Any, new: Any) -> list[tuple[str, Any, Any]]:
    """Name, old and new value of everything that differs; objects are compared entry by entry, as NAME.ENTRY."""
    if isinstance(old, dict) and isinstance(new, dict):
        return [
            change
            for key in sorted({*old, *new})
            for change in _changes(f"{name}.{key}", old.get(key), new.get(key))
        ]
    return [(name, old, new)] if old != new else []


def _stored_hash(path: Path) -> str:
    """The hash of the config in a file; empty where there is no config to compare with."""
    try:
        return config_hash(read_json_object(path))
    except UsageError:
        return ""


def _check_same_run(record: EpisodeRecord, wanted: str, what: str) -> None:
    """Refuse a record of another config than the ``wanted`` one ("" for any). ``what``: the record, for messages."""
    again = "Run it again with --overwrite, or into another folder."
    if wanted and not record.config_hash:
        raise UsageError(
            f"{what} does not name its config (it has no config_hash), so it may come from another run. {again}"
        )
    if wanted and record.config_hash != wanted:
        raise UsageError(
            f"{what} comes from another run: its config has the hash {record.config_hash}, {CONFIG} beside it "
            f"{wanted}. Two runs were written into one folder, or {CONFIG} was changed. {again}"
        )


def _check_records(records: Sequence[EpisodeRecord], wanted: str, path: Path) -> None:
    """Refuse records of another config than ``wanted`` ("" for any), and a second record of an episode."""
    seen: set[int] = set()
    for number, record in enumerate(records, 1):
        _check_same_run(
            record, wanted, f"line {number} of {path} (episode {record.index})"
        )
        if record.index in seen:
            raise UsageError(
                f"line {number} of {path}: episode {record.index} is there twice. Run it again with --overwrite."
            )
        seen.add(record.index)


def _read_file(path: Path) -> tuple[list[EpisodeRecord], int]:
    """Return the records of a file and the number of bytes they take: a line torn at the very end is left out.

    Raises:
        UsageError: a finished line is no record.
    """
    whole = path.read_bytes() if path.is_file() else b""
    kept = []
    end = 0
    for number, line in enumerate(whole.splitlines(keepends=True), 1):
        try:
            if not line.endswith(b"\n"):
                raise ValueError("the line is not finished")
            record = EpisodeRecord.from_dict(parse_json(line))
        except ValueError as error:
            if line.endswith(b"\n"):
                said = reason(error)
                raise UsageError(
                    f"line {number} of {path} is damaged ({said}). Start the run again with --overwrite."
                ) from error
            break
        kept.append(record)
        end += len(line)
    return kept, end


def _take_records(path: Path, wanted: str) -> list[EpisodeRecord]:
    """Read a file that will be continued: cut off what a crash left at its end.

    A run that can be continued has the config of this version of mjhab, which writes the hash into every record.
    """
    kept, end = _read_file(path)
    _check_records(kept, wanted, path)
    if path.is_file() and end < path.stat().st_size:
        with open(path, "r+b") as file:
            file.truncate(end)
    return kept
