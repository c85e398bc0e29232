"""The result file of a score: everything that was done, so that everything that it claims can be computed again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.reading import parse_json
from mjhab.evaluation.score.capabilities import profile
from mjhab.evaluation.score.manifest import Manifest, Row, manifest
from mjhab.reports.metrics import label_counts, mean, wilson
from mjhab.rollout.records import EpisodeRecord

FORMAT = "mjhab-score"
VERSION = 1
MAX_FILE_BYTES = 1 << 30


@dataclass(frozen=True)
class Scored:
    """One episode of a score: name of its row, what happened, digest of its start, its actions as text."""

    row: str
    record: EpisodeRecord
    start: str
    actions: str


@dataclass(frozen=True)
class Result:
    """A result file. ``facts``: who was scored, where and with what; plain JSON data. ``summary``: see `summary_of`."""

    facts: Mapping[str, Any]
    summary: Mapping[str, Any]
    episodes: tuple[Scored, ...]
    digest: str

    @property
    def manifest(self) -> Manifest:
        """What was asked for.

        Raises:
            UsageError: the file names an unknown track or split.
        """
        return manifest(str(self.facts["track"]), str(self.facts["split"]))


def summary_of(asked: Manifest, episodes: Sequence[Scored]) -> dict[str, Any]:
    """The numbers of a result, all of them computed from its episodes.

    Returns:
        "score": mean over the rows. A row of a subtask has the share of its episodes that succeed once; a row of a
        chain the mean share of its plan that was completed. Episodes that are tainted, or that the policy could not
        finish, count 0, and so do rows without episodes. "episodes": how many there are. "complete": these are all
        episodes of the manifest, with its starts. "other_starts": how many began elsewhere than the manifest says.
        "tainted", "errors": counts. "rows": one per row. "labels": counts. "capabilities": see `capabilities.profile`.
    """
    rows = [_row_summary(row, [e for e in episodes if e.row == row.name]) for row in asked.rows]
    others = sum(_begins_elsewhere(asked, episode) for episode in episodes)
    subtasks = [subtask for episode in episodes for subtask in episode.record.subtasks]
    wanted = sum(row.episodes for row in asked.rows)
    return {
        "score": mean(row["score"] for row in rows),
        "episodes": len(episodes),
        "complete": len(episodes) == wanted and not others,
        "other_starts": others,
        "tainted": sum(bool(episode.record.taint) for episode in episodes),
        "errors": sum(bool(episode.record.error) for episode in episodes),
        "rows": rows,
        "labels": label_counts(subtask.label for subtask in subtasks),
        "capabilities": profile(subtasks),
    }


def _begins_elsewhere(asked: Manifest, episode: Scored) -> bool:
    """Whether the manifest knows another start for an episode."""
    starts = asked.starts.get(episode.row)
    return starts is not None and starts[episode.record.index] != episode.start


def _row_summary(row: Row, episodes: Sequence[Scored]) -> dict[str, Any]:
    clean = [e.record for e in episodes if not (e.record.taint or e.record.error)]
    won = sum(record.success_once for record in clean)
    done = won
    if not row.subtask:
        done = sum(record.completed / len(record.plan) for record in clean)
    count = len(episodes)
    return {
        **asdict(row),
        "name": row.name,
        "done": count,
        "score": _share(done, count),
        "success_once": _share(won, count),
        "interval": list(wilson(won, count)),
    }


def _share(part: float, whole: int) -> float:
    return round(part / whole, 4) if whole else 0.0


def write_result(path: Path, facts: Mapping[str, Any], episodes: Sequence[Scored]) -> Result:
    """Write a result file; returns what is in it."""
    asked = manifest(str(facts["track"]), str(facts["split"]))
    content = {
        "format": FORMAT,
        "version": VERSION,
        "facts": dict(facts),
        "summary": summary_of(asked, episodes),
        "episodes": [
            {"row": e.row, "start": e.start, "actions": e.actions, "record": e.record.to_dict()}
            for e in episodes
        ],
    }
    content["digest"] = digest_of(content)
    text = json.dumps(content, separators=(",", ":"))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    return read_result(path)


def digest_of(content: Mapping[str, Any]) -> str:
    """SHA-256 over everything in a result file but its digest."""
    rest = {key: value for key, value in content.items() if key != "digest"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def read_result(path: Path) -> Result:
    """Read a result file.

    Raises:
        UsageError: it is none, it was edited, or its numbers are not those of its episodes.
    """
    content = _read_json(path)
    if content.get("format") != FORMAT or content.get("version") != VERSION:
        raise UsageError(
            f"{path} is no result file of version {VERSION}; `mjhab score` writes them."
        )
    if content.get("digest") != digest_of(content):
        raise UsageError(f"{path} was edited: its digest is not that of its content.")
    try:
        episodes = tuple(
            Scored(
                str(entry["row"]),
                EpisodeRecord.from_dict(entry["record"]),
                str(entry["start"]),
                str(entry["actions"]),
            )
            for entry in content["episodes"]
        )
        result = Result(
            dict(content["facts"]), dict(content["summary"]), episodes, str(content["digest"])
        )
        asked = result.manifest
        made_for = result.facts["manifest"]
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{path} is damaged: {error!r}.") from error
    _check_names(path, asked, episodes)
    if made_for != asked.digest:
        raise UsageError(
            f"{path} was made with the manifest {made_for}, and this version of mjhab has {asked.digest}: such scores "
            "cannot be compared. Score the policy again."
        )
    if json.loads(json.dumps(summary_of(asked, episodes))) != result.summary:
        raise UsageError(f"{path} was edited: its numbers are not those of its episodes.")
    return result


def _read_json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise UsageError(f"there is no file {path}.")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise UsageError(f"{path} is larger than any result file.")
    try:
        content = parse_json(path.read_bytes())
    except ValueError as error:
        raise UsageError(f"{path} is no result file: {error}.") from error
    if not isinstance(content, dict):
        raise UsageError(f"{path} is no result file.")
    return content


def _check_names(path: Path, asked: Manifest, episodes: Sequence[Scored]) -> None:
    """Refuse episodes that the manifest does not name, and those that are there twice."""
    rows = {row.name: row for row in asked.rows}
    seen: set[tuple[str, int]] = set()
    for episode in episodes:
        record = episode.record
        row = rows.get(episode.row)
        name = (episode.row, record.index)
        if row is None or not _fits(row, asked, record) or name in seen:
            raise UsageError(
                f"{path}: episode {record.index} of {episode.row} is not in the manifest."
            )
        seen.add(name)


def _fits(row: Row, asked: Manifest, record: EpisodeRecord) -> bool:
    """Whether an episode is one of a row."""
    wanted = (row.task, row.subtask or None, asked.split, asked.seed)
    got = (record.task, record.subtask, record.split, record.seed)
    about = record.plan[0].target if record.plan else ""
    return wanted == got and about.startswith(row.target) and 0 <= record.index < row.episodes
