"""The run folder: what survives a crash, Ctrl-C and a second start.

config.json      resolved options; a resumed run must match them
episodes.jsonl   one record per finished episode, flushed as it finishes
films/           films of the first episodes
summary.json     written at the end, also after Ctrl-C
report.html      likewise
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mjhab.core.cache import write_atomic
from mjhab.core.errors import UsageError
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink

CONFIG, EPISODES, SUMMARY, REPORT, FILMS = "config.json", "episodes.jsonl", "summary.json", "report.html", "films"
OWN = frozenset({CONFIG, EPISODES, SUMMARY, REPORT, FILMS})
FREE_KEYS = frozenset({"episodes", "films", "worlds", "threads"})
"""Config keys that a resumed run may change: they do not alter what happens in an episode."""


class RunFolder:
    """An opened run folder. Make one with ``RunFolder.open``."""

    def __init__(self, path: Path, config: Mapping[str, Any], records: list[EpisodeRecord]) -> None:
        self.path, self.config = path, dict(config)
        self._records = {record.index: record for record in records}

    @classmethod
    def open(cls, path: Path, config: Mapping[str, Any], *, resume: bool = False, overwrite: bool = False) -> RunFolder:
        """Prepare ``path`` for a run with ``config`` (plain JSON data) and save the config there.

        Args:
            path: the folder; made if missing.
            config: resolved options of the run.
            resume: continue a run that has the same config (``FREE_KEYS`` may differ).
            overwrite: delete what an earlier run left in the folder; files of others stay.

        Raises:
            UsageError: both switches; the folder holds something and neither switch is given; the folder to resume
                holds other files than a run's, or a run with another config; ``path`` is a file.
        """
        if resume and overwrite:
            raise UsageError("--resume and --overwrite exclude each other; give one of them.")
        if path.exists() and not path.is_dir():
            raise UsageError(f"the output path {path} is a file; give a folder.")
        config = json.loads(json.dumps(config))
        found = sorted(entry.name for entry in path.iterdir()) if path.exists() else []
        records: list[EpisodeRecord] = []
        if found and not (resume or overwrite):
            raise UsageError(
                f"the output folder {path} is not empty (it holds {_some(found)}). Give --resume to continue that run, "
                "--overwrite to start it again, or another --out."
            )
        if found and overwrite:
            _delete_own(path)
        elif found:
            _check_same(path, config)
            records = _read_records(path / EPISODES)
        path.mkdir(parents=True, exist_ok=True)
        write_text(path / CONFIG, json.dumps(config, indent=2) + "\n")
        return cls(path, config, records)

    @property
    def records(self) -> list[EpisodeRecord]:
        """All finished episodes, of this start and of earlier ones, sorted by index."""
        return [self._records[index] for index in sorted(self._records)]

    def missing(self, episodes: int) -> list[int]:
        """Indices below ``episodes`` that have no record yet."""
        return [index for index in range(episodes) if index not in self._records]

    def add(self, record: EpisodeRecord) -> None:
        """Append a record to episodes.jsonl and flush it to the system."""
        with open(self.path / EPISODES, "a", encoding="utf-8") as file:
            file.write(json.dumps(record.to_dict(), separators=(",", ":")) + "\n")
        self._records[record.index] = record

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


class StoreSink(Sink):
    """Puts every finished episode into the run folder at once."""

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder

    def on_episode_end(self, env: Any, world: int, record: EpisodeRecord) -> None:
        """Append the record."""
        self._folder.add(record)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` so that a reader sees the old file or the new one, never a part."""
    write_atomic(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _delete_own(path: Path) -> None:
    for name in OWN:
        entry = path / name
        if entry.is_dir():
            for film in entry.glob("episode_*.mp4*"):
                film.unlink()
            if not any(entry.iterdir()):
                entry.rmdir()
        else:
            entry.unlink(missing_ok=True)


def _check_same(path: Path, config: Mapping[str, Any]) -> None:
    if not (path / CONFIG).is_file():
        raise UsageError(f"nothing to resume in {path}: it has no {CONFIG}. Give an empty or new folder as --out.")
    try:
        old = json.loads((path / CONFIG).read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise UsageError(f"cannot resume: {path / CONFIG} is not JSON ({error}). Use --overwrite.") from error
    for key in sorted({*old, *config} - FREE_KEYS):
        if old.get(key) != config.get(key):
            raise UsageError(
                f"cannot resume {path}: it was started with {key} = {old.get(key)!r}, now it is {config.get(key)!r}. "
                "Use the same options, or --overwrite, or another --out."
            )


def _read_records(path: Path) -> list[EpisodeRecord]:
    """Read episodes.jsonl; a line torn by a crash at the very end is cut off the file."""
    if not path.is_file():
        return []
    whole = path.read_bytes()
    kept, end = [], 0
    for number, line in enumerate(whole.splitlines(keepends=True), 1):
        try:
            if not line.endswith(b"\n"):
                raise ValueError("the line is not finished")
            kept.append(EpisodeRecord.from_dict(json.loads(line)))
        except (ValueError, KeyError, TypeError) as error:
            if end + len(line) < len(whole):
                raise UsageError(
                    f"cannot resume: line {number} of {path} is damaged ({error}). Use --overwrite."
                ) from error
            break
        end += len(line)
    if end < len(whole):
        with open(path, "r+b") as file:
            file.truncate(end)
    return kept
