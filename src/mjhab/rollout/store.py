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

from mjhab.core.errors import UsageError, fault
from mjhab.core.files.locking import WriteLock
from mjhab.core.files.outputs import naming_file
from mjhab.core.files.reading import parse_json, read_json_object, reason
from mjhab.core.files.run_folder import CONFIG, REPORT, SUMMARY, RunFolder
from mjhab.rollout.indices import IndicesLeft
from mjhab.rollout.policy import RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink

EPISODES_FILE = "episodes.jsonl"
FILMS = "films"


class EvaluationFolder(RunFolder):
    """The folder of an evaluation: it has work as soon as it has a record.

    Raises:
        UsageError: when it is opened; also where a record in the middle of the file is damaged or of another run.
    """

    OWN = frozenset({CONFIG, EPISODES_FILE, SUMMARY, REPORT, FILMS})
    FREE_KEYS = frozenset({"episodes", "films", "worlds", "threads"})

    def __init__(self, path: Path, config: Mapping[str, Any], lock: WriteLock) -> None:
        super().__init__(path, config, lock)
        self._hash = config_hash(config)
        self._records: dict[int, EpisodeRecord] = {}

    def _take_up(self) -> None:
        records = _take_records(self.path / EPISODES_FILE, self._hash)
        self._records = {record.index: record for record in records}

    def _has_work(self) -> bool:
        return bool(self._records)

    def _delete_own(self) -> None:
        films = self.path / FILMS
        # Also what an encoder left unfinished.
        for film in (*films.glob("episode_*.mp4*"), *films.glob(".episode_*.part.mp4")):
            film.unlink()
        # Films of others stay.
        if films.is_dir() and not any(films.iterdir()):
            films.rmdir()
        for name in self.OWN - {FILMS}:
            (self.path / name).unlink(missing_ok=True)

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
        path = self.path / EPISODES_FILE
        # One write per record: a crash tears the last line at most.
        line = json.dumps(record.to_dict(), separators=(",", ":")) + "\n"
        # Opened for each record, so that it is flushed and no handle stays open over hours.
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
        """Those of the named entries, maps or counts, that the summary of the last start has."""
        summary = self._earlier_summary()
        return {
            name: summary[name]
            for name in names
            if isinstance(summary.get(name), dict | int)
        }

    def _earlier_summary(self) -> dict[str, Any]:
        """The summary of the last start; empty if there is none that can be read."""
        try:
            return read_json_object(self.path / SUMMARY)
        except UsageError:
            return {}

    def film_path(self, index: int) -> Path:
        """Where the film of an episode belongs."""
        return film_path(self.path, index)


def film_path(folder: Path, index: int) -> Path:
    """Where the film of an episode belongs in the folder of an evaluation."""
    return folder / FILMS / f"episode_{index:05d}.mp4"


class StoreSink(Sink[RolloutEnv]):
    """Puts every finished episode into the run folder at once."""

    def __init__(self, folder: EvaluationFolder) -> None:
        self._folder = folder

    def on_episode_end(self, env: RolloutEnv, world: int, record: EpisodeRecord) -> None:
        """Append the record."""
        self._folder.add(record)


def read_records(folder: Path) -> list[EpisodeRecord]:
    """Return the finished episodes of a run folder, which may still be running; changes nothing.

    Raises:
        UsageError: a record that is not the last one is damaged, belongs to another config than the folder's, or names
            none (in a folder of an older version, no record names one); or an episode is there twice.
    """
    path = folder / EPISODES_FILE
    kept, _ = _read_file(path)
    # Older folders have none in any record, and are read without a comparison.
    hashed = any(record.config_hash for record in kept)
    _check_records(kept, _stored_hash(folder / CONFIG) if hashed else "", path)
    return kept


def config_hash(config: Mapping[str, Any]) -> str:
    """Name of a config: equal for configs that a resumed run may have (`EvaluationFolder.FREE_KEYS`)."""
    fixed = {
        key: value
        for key, value in config.items()
        # None is left out, so that an option which a later version adds does not change the name.
        if key not in EvaluationFolder.FREE_KEYS and value is not None
    }
    # Sorted: the order of options means nothing.
    text = json.dumps(fixed, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


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
        raise fault(
            what,
            f"does not name its config (it has no config_hash), so it may come from another run. {again}",
        )
    if wanted and record.config_hash != wanted:
        raise fault(
            what,
            f"comes from another run: its config has the hash {record.config_hash}, {CONFIG} beside it "
            f"{wanted}. Two runs were written into one folder, or {CONFIG} was changed. {again}",
        )


def _check_records(records: Sequence[EpisodeRecord], wanted: str, path: Path) -> None:
    """Refuse records of another config than ``wanted`` ("" for any), and a second record of an episode."""
    seen: set[int] = set()
    for number, record in enumerate(records, 1):
        _check_same_run(
            record, wanted, f"line {number} of {path} (episode {record.index})"
        )
        if record.index in seen:
            raise fault(
                f"line {number} of {path}",
                f"episode {record.index} is there twice. Run it again with --overwrite.",
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
            # The last write of a process that was killed.
            if not line.endswith(b"\n"):
                raise ValueError("the line is not finished")
            record = EpisodeRecord.from_dict(parse_json(line))
        except ValueError as error:
            if line.endswith(b"\n"):
                said = reason(error)
                raise fault(
                    f"line {number} of {path}",
                    f"is damaged ({said}). Start the run again with --overwrite.",
                ) from error
            # Nothing can follow: a torn line is the last one.
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
