"""The result file of a score: it holds all records and actions, so that its numbers can be verified.

Beside it lies its summary: what tables show, without the episodes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.reading import parse_json
from mjhab.evaluation.score.capabilities import profile
from mjhab.evaluation.score.manifest import Manifest, ScoreRow, manifest
from mjhab.reports.metrics import label_counts, mean, wilson
from mjhab.robots.registry import DEFAULT_ROBOT
from mjhab.rollout.records import EpisodeRecord

FORMAT = "mjhab-score"
SUMMARY_FORMAT = "mjhab-score-summary"
VERSION = 1
RESULT_FILE = "result.json"
MAX_FILE_BYTES = 1 << 30


@dataclass(frozen=True)
class ScoredEpisode:
    """One episode of a score.

    row: name of its row. record: its results. start: digest of its start state. actions: see `actions.packed_actions`.
    """

    row: str
    record: EpisodeRecord
    start: str
    actions: str


@dataclass(frozen=True)
class ScoreResult:
    """Content of a result file, or of its summary, which has no episodes.

    facts: policy, track, versions and hardware, as JSON data. summary: see `summary_of`. digest: see `digest_of`.
    """

    facts: Mapping[str, Any]
    summary: Mapping[str, Any]
    episodes: tuple[ScoredEpisode, ...]
    digest: str

    @property
    def manifest(self) -> Manifest:
        """Manifest of the result's track, split and robot.

        Raises:
            UsageError: the file names an unknown track, split or robot.
        """
        return manifest_of(self.facts)


def manifest_of(facts: Mapping[str, Any]) -> Manifest:
    """Manifest of the track, split and robot that a result names; older results name no robot.

    Raises:
        UsageError: one of them is unknown.
    """
    robot = str(facts.get("robot", DEFAULT_ROBOT))
    return manifest(str(facts["track"]), str(facts["split"]), robot)


def summary_of(asked: Manifest, episodes: Sequence[ScoredEpisode]) -> dict[str, Any]:
    """Compute the numbers of a result from its episodes.

    Returns:
        "score": mean over the rows. The score of a subtask row is its success-once rate; that of a chain row is the
        mean fraction of the plan that was completed. Tainted episodes and those with a policy error count 0, as do
        rows without episodes. "episodes": their number. "complete": whether these are all episodes of the manifest,
        with its start states. "other_starts": number of episodes with another start state than in the manifest.
        "tainted", "errors": counts. "rows": one per row. "labels": counts. "capabilities": see `capabilities.profile`.
    """
    rows = [
        _row_summary(row, [e for e in episodes if e.row == row.name])
        for row in asked.rows
    ]
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


def _begins_elsewhere(asked: Manifest, episode: ScoredEpisode) -> bool:
    """Whether an episode's start state differs from the one in the manifest."""
    starts = asked.starts.get(episode.row)
    return starts is not None and starts[episode.record.index] != episode.start


def _row_summary(row: ScoreRow, episodes: Sequence[ScoredEpisode]) -> dict[str, Any]:
    clean = [e.record for e in episodes if not (e.record.taint or e.record.error)]
    won = sum(record.success_once for record in clean)
    done = won
    if not row.subtask:
        done = ordered_sum(record.completed / len(record.plan) for record in clean)
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


def write_result(
    path: Path, facts: Mapping[str, Any], episodes: Sequence[ScoredEpisode]
) -> ScoreResult:
    """Write a result file and return its content."""
    asked = manifest_of(facts)
    content = {
        "format": FORMAT,
        "version": VERSION,
        "facts": dict(facts),
        "summary": summary_of(asked, episodes),
        "episodes": [
            {
                "row": e.row,
                "start": e.start,
                "actions": e.actions,
                "record": e.record.to_dict(),
            }
            for e in episodes
        ],
    }
    content["digest"] = digest_of(content)
    text = json.dumps(content, separators=(",", ":"))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    return read_result(path)


def write_summary(path: Path, result: ScoreResult) -> None:
    """Write what tables show of a result: facts, numbers, and the digest of the result file."""
    content = {
        "format": SUMMARY_FORMAT,
        "version": VERSION,
        "facts": dict(result.facts),
        "summary": dict(result.summary),
        "digest": result.digest,
    }
    text = json.dumps(content, indent=1) + "\n"
    write_atomic(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def read_for_table(path: Path) -> ScoreResult:
    """Read a result file, or its summary, whose numbers cannot be verified; the episodes of the latter are left out.

    Raises:
        UsageError: see `read_result`.
    """
    content = _read_json(path)
    if content.get("format") != SUMMARY_FORMAT:
        return _result_of(path, content)
    if content.get("version") != VERSION:
        raise UsageError(
            f"{path} is not a summary of version {VERSION}; `mjhab score` writes them."
        )
    try:
        result = ScoreResult(
            dict(content["facts"]), dict(content["summary"]), (), str(content["digest"])
        )
        asked = result.manifest
        made_for = result.facts["manifest"]
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{path} is damaged: {error!r}.") from error
    _check_facts(path, result.facts, asked)
    _check_manifest(path, made_for, asked)
    # Without episodes the numbers cannot be computed again, but their places are known.
    empty = json.loads(json.dumps(summary_of(asked, ())))
    if not _is_like({**result.summary, "labels": {}}, empty):
        raise UsageError(f"{path} is damaged: its summary is not that of a score.")
    return result


def _is_like(value: object, example: object) -> bool:
    """Whether JSON data have the same keys, lengths and texts as an example, and numbers where it has some."""
    if isinstance(example, dict):
        return (
            isinstance(value, dict)
            and value.keys() == example.keys()
            and all(_is_like(value[key], example[key]) for key in example)
        )
    if isinstance(example, list):
        return (
            isinstance(value, list)
            and len(value) == len(example)
            and all(_is_like(*pair) for pair in zip(value, example, strict=True))
        )
    if isinstance(example, str):
        return value == example
    return isinstance(value, int | float) or (value is None and example is None)


def digest_of(content: Mapping[str, Any]) -> str:
    """SHA-256 over the content of a result file without its digest."""
    rest = {key: value for key, value in content.items() if key != "digest"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def read_result(path: Path) -> ScoreResult:
    """Read a result file.

    Raises:
        UsageError: it is not a result file, it was edited, or its numbers do not follow from its episodes.
    """
    return _result_of(path, _read_json(path))


def _result_of(path: Path, content: Mapping[str, Any]) -> ScoreResult:
    """The checked content of a result file, see `read_result`."""
    if content.get("format") == SUMMARY_FORMAT:
        raise UsageError(
            f"{path} is a summary, which has no episodes to verify; give the result.json beside it."
        )
    if content.get("format") != FORMAT or content.get("version") != VERSION:
        raise UsageError(
            f"{path} is not a result file of version {VERSION}; `mjhab score` writes them."
        )
    if content.get("digest") != digest_of(content):
        raise UsageError(f"{path} was edited: its digest does not match its content.")
    try:
        episodes = tuple(
            ScoredEpisode(
                str(entry["row"]),
                EpisodeRecord.from_dict(entry["record"]),
                str(entry["start"]),
                str(entry["actions"]),
            )
            for entry in content["episodes"]
        )
        result = ScoreResult(
            dict(content["facts"]),
            dict(content["summary"]),
            episodes,
            str(content["digest"]),
        )
        asked = result.manifest
        made_for = result.facts["manifest"]
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{path} is damaged: {error!r}.") from error
    _check_facts(path, result.facts, asked)
    _check_names(path, asked, episodes)
    lacking = sorted(
        {episode.row for episode in episodes} - set(result.facts["policies"])
    )
    if lacking:
        raise UsageError(f"{path} was edited: facts.policies lacks {', '.join(lacking)}.")
    _check_manifest(path, made_for, asked)
    if json.loads(json.dumps(summary_of(asked, episodes))) != result.summary:
        raise UsageError(
            f"{path} was edited: its numbers do not follow from its episodes."
        )
    return result


def _read_json(path: Path) -> dict[str, Any]:
    if path.is_dir():
        raise UsageError(f"{path} is a folder; give the {RESULT_FILE} in it.")
    if not path.is_file():
        raise UsageError(f"there is no file {path}.")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise UsageError(f"{path} is larger than any result file.")
    try:
        content = parse_json(path.read_bytes())
    except ValueError as error:
        raise UsageError(f"{path} is not a result file: {error}.") from error
    if not isinstance(content, dict):
        raise UsageError(f"{path} is not a result file.")
    return content


def _check_facts(path: Path, facts: Mapping[str, Any], asked: Manifest) -> None:
    """Refuse facts that the check of a result or the leaderboard cannot read.

    Raises:
        UsageError: names the entry.
    """
    kinds = {"policy": str, "policies": dict, "versions": dict, "hardware": dict}
    for name, kind in kinds.items():
        if not isinstance(facts.get(name), kind):
            raise UsageError(
                f"{path} was edited: facts.{name} must be a {kind.__name__}, got "
                f"{facts.get(name)!r}."
            )
    policies = facts["policies"]
    for row in asked.rows:
        about = policies.get(row.name)
        if about is not None and not isinstance(
            about.get("env_options") if isinstance(about, dict) else None, dict
        ):
            raise UsageError(
                f"{path} was edited: facts.policies[{row.name!r}] has no env_options."
            )


def _check_manifest(path: Path, made_for: object, asked: Manifest) -> None:
    if made_for != asked.digest:
        raise UsageError(
            f"{path} was made with the manifest {made_for}, and this version of mjhab has {asked.digest}: such scores "
            "cannot be compared. Score the policy again."
        )


def _check_names(path: Path, asked: Manifest, episodes: Sequence[ScoredEpisode]) -> None:
    """Refuse episodes that are not in the manifest, and duplicates."""
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


def _fits(row: ScoreRow, asked: Manifest, record: EpisodeRecord) -> bool:
    """Whether an episode belongs to a row."""
    wanted = (row.task, row.subtask or None, asked.split, asked.seed)
    got = (record.task, record.subtask, record.split, record.seed)
    about = record.plan[0].target if record.plan else ""
    return (
        wanted == got
        and about.startswith(row.target)
        and 0 <= record.index < row.episodes
    )
