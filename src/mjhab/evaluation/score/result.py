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

from mjhab.core.errors import about, fault, wrong_type, wrong_value
from mjhab.core.files.cache import write_text
from mjhab.core.files.reading import parse_json
from mjhab.evaluation.score.manifest import Manifest, ScoreHomes, ScoreRow, manifest
from mjhab.evaluation.score.summary import ScoredEpisode, summary_of
from mjhab.robots.registry import DEFAULT_ROBOT
from mjhab.rollout.records import EpisodeRecord

FORMAT = "mjhab-score"
SUMMARY_FORMAT = "mjhab-score-summary"
VERSION = 1
RESULT_FILE = "result.json"
# More would fill the memory before anything of it is checked.
MAX_FILE_BYTES = 1 << 30
ARM_FIELDS: Mapping[str, Any] = {
    "axis": str,
    "level": int,
    "success_once": int | float,
    "difference": int | float,
    "low": int | float,
    "high": int | float,
    "episodes": int,
}
"""What a result tells of each axis that its episodes were run under, by type."""


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
        """Manifest of the result's track, split, robot and homes.

        Raises:
            UsageError: the file names an unknown track, split or robot.
        """
        return manifest_of(self.facts)


def manifest_of(facts: Mapping[str, Any]) -> Manifest:
    """Manifest of track, split, robot and homes that a result names; older results name neither robot nor homes.

    Raises:
        UsageError: one of them is unknown.
        TypeError: the homes are not those of `ScoreHomes`.
    """
    robot = str(facts.get("robot", DEFAULT_ROBOT))
    homes = ScoreHomes(**facts.get("homes", {}))
    if not all(isinstance(value, str) for value in asdict(homes).values()):
        raise TypeError(f"facts.homes must be texts, got {facts['homes']!r}")
    return manifest(str(facts["track"]), str(facts["split"]), robot, homes)


def perturbed_arms(facts: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Numbers of the arms of `mjhab score --perturb` in the facts of a result; empty without.

    Raises:
        UsageError: they are not such numbers.
    """
    arms = facts.get("perturbed", [])
    if not isinstance(arms, list):
        raise wrong_type("facts.perturbed", arms, "a list")
    for arm in arms:
        fits = isinstance(arm, dict) and all(
            # JSON's true is an int to Python.
            isinstance(arm.get(name), kind) and not isinstance(arm[name], bool)
            for name, kind in ARM_FIELDS.items()
        )
        if not fits:
            raise wrong_value(
                "facts.perturbed", arm, f"arms with {', '.join(ARM_FIELDS)}"
            )
    return arms


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
                **({} if e.continuing is None else {"continuing": e.continuing}),
            }
            for e in episodes
        ],
    }
    content["digest"] = digest_of(content)
    text = json.dumps(content, separators=(",", ":"))
    write_text(path, text)
    # Read back, so that what is returned is what the check of others will see.
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
    write_text(path, text)


def read_for_table(path: Path) -> ScoreResult:
    """Read a result file, or its summary, whose numbers cannot be verified; the episodes of the latter are left out.

    Raises:
        UsageError: see `read_result`.
    """
    content = _read_json(path)
    if content.get("format") != SUMMARY_FORMAT:
        return _result_of(path, content)
    if content.get("version") != VERSION:
        raise fault(
            path, f"not a summary of version {VERSION}; `mjhab score` writes them."
        )
    try:
        result = _made_of(content, ())
        asked = result.manifest
        made_for = result.facts["manifest"]
    except (KeyError, TypeError, ValueError) as error:
        raise fault(path, f"damaged: {error!r}.") from error
    _check_facts(path, result.facts, asked)
    _check_manifest(path, made_for, asked)
    # Without episodes the numbers cannot be computed again, but their places are known.
    empty = json.loads(json.dumps(summary_of(asked, ())))
    if not _is_like({**result.summary, "labels": {}}, empty):
        raise fault(path, "damaged: its summary is not that of a score.")
    return result


def _made_of(
    content: Mapping[str, Any], episodes: tuple[ScoredEpisode, ...]
) -> ScoreResult:
    return ScoreResult(
        dict(content["facts"]),
        dict(content["summary"]),
        episodes,
        str(content["digest"]),
    )


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
    # Sorted, so that the digest does not depend on who wrote the file.
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
        raise fault(
            path,
            "a summary, which has no episodes to verify; give the result.json beside it.",
        )
    if content.get("format") != FORMAT or content.get("version") != VERSION:
        raise fault(
            path, f"not a result file of version {VERSION}; `mjhab score` writes them."
        )
    if content.get("digest") != digest_of(content):
        raise fault(path, "was edited: its digest does not match its content.")
    try:
        episodes = tuple(
            ScoredEpisode(
                str(entry["row"]),
                EpisodeRecord.from_dict(entry["record"]),
                str(entry["start"]),
                str(entry["actions"]),
                entry.get("continuing"),
            )
            for entry in content["episodes"]
        )
        result = _made_of(content, episodes)
        asked = result.manifest
        made_for = result.facts["manifest"]
    except (KeyError, TypeError, ValueError) as error:
        raise fault(path, f"damaged: {error!r}.") from error
    # Before anything that reads them: the file may come from anybody.
    _check_facts(path, result.facts, asked)
    _check_names(path, asked, episodes)
    lacking = sorted(
        {episode.row for episode in episodes} - set(result.facts["policies"])
    )
    if lacking:
        raise fault(path, f"was edited: facts.policies lacks {', '.join(lacking)}.")
    _check_manifest(path, made_for, asked)
    # Through JSON: tuples become lists there, and counters plain dicts.
    if json.loads(json.dumps(summary_of(asked, episodes))) != result.summary:
        raise fault(path, "was edited: its numbers do not follow from its episodes.")
    return result


def _read_json(path: Path) -> dict[str, Any]:
    if path.is_dir():
        raise fault(path, f"a folder; give the {RESULT_FILE} in it.")
    if not path.is_file():
        raise fault(path, "does not exist.")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise fault(path, "larger than any result file.")
    try:
        content = parse_json(path.read_bytes())
    except ValueError as error:
        raise fault(path, f"not a result file: {error}.") from error
    if not isinstance(content, dict):
        raise fault(path, "not a result file.")
    return content


def _check_facts(path: Path, facts: Mapping[str, Any], asked: Manifest) -> None:
    """Refuse facts that the check of a result or the leaderboard cannot read.

    Raises:
        UsageError: names the entry.
    """
    kinds = {"policy": str, "policies": dict, "versions": dict, "hardware": dict}
    for name, kind in kinds.items():
        if not isinstance(facts.get(name), kind):
            raise fault(
                path,
                f"was edited: facts.{name} must be a {kind.__name__}, got "
                f"{facts.get(name)!r}.",
            )
    with about(f"{path} was edited"):
        perturbed_arms(facts)
    policies = facts["policies"]
    for row in asked.rows:
        told = policies.get(row.name)
        if told is not None and not isinstance(
            told.get("env_options") if isinstance(told, dict) else None, dict
        ):
            raise fault(
                path, f"was edited: facts.policies[{row.name!r}] has no env_options."
            )


def _check_manifest(path: Path, made_for: object, asked: Manifest) -> None:
    if made_for != asked.digest:
        raise fault(
            path,
            f"was made with the manifest {made_for}, and this version of mjhab has {asked.digest}: such scores "
            "cannot be compared. Score the policy again.",
        )


def _check_names(path: Path, asked: Manifest, episodes: Sequence[ScoredEpisode]) -> None:
    """Refuse episodes that are not in the manifest, and duplicates."""
    rows = {row.name: row for row in asked.rows}
    seen: set[tuple[str, int, int]] = set()
    for episode in episodes:
        record = episode.record
        row = rows.get(episode.row)
        name = (episode.row, record.seed, record.index)
        if row is None or not _fits(row, asked, episode) or name in seen:
            raise fault(
                path, f"episode {record.index} of {episode.row} is not in the manifest."
            )
        seen.add(name)


def _fits(row: ScoreRow, asked: Manifest, episode: ScoredEpisode) -> bool:
    """Whether an episode belongs to a row and tells what its track asks for."""
    record = episode.record
    wanted = (row.task, row.subtask or None, asked.split)
    got = (record.task, record.subtask, record.split)
    about = record.plan[0].target if record.plan else ""
    return (
        wanted == got
        and record.seed in asked.seeds
        and isinstance(episode.continuing, bool) == asked.continuing
        and about.startswith(row.target)
        and 0 <= record.index < row.episodes
    )
