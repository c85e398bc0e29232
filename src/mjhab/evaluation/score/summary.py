"""The numbers of a score, computed from its episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.evaluation.score.capabilities import profile
from mjhab.evaluation.score.manifest import Manifest, ScoreRow
from mjhab.reports.metrics import label_counts, mean, wilson
from mjhab.rollout.records import EpisodeRecord


@dataclass(frozen=True)
class ScoredEpisode:
    """One episode of a score.

    row: name of its row. record: its results. start: digest of its start state. actions: see `actions.packed_actions`.
    continuing: whether it succeeded in some step, also after a failing termination; None in tracks that do not ask.
    """

    row: str
    record: EpisodeRecord
    start: str
    actions: str
    continuing: bool | None = None


def summary_of(asked: Manifest, episodes: Sequence[ScoredEpisode]) -> dict[str, Any]:
    """Compute the numbers of a result from its episodes.

    Returns:
        "score": mean over the rows. The score of a subtask row is its success-once rate; that of a chain row is the
        mean fraction of the plan that was completed. Tainted episodes and those with a policy error count 0, as do
        rows without episodes. "episodes": their number. "complete": whether these are all episodes of the manifest,
        with its start states. "other_starts": number of episodes with another start state than in the manifest.
        "tainted", "errors": counts. "rows": one per row. "labels": counts. "capabilities": see `capabilities.profile`.
        In tracks that count successes after a failing termination also "score_continuing", the mean of these.
    """
    rows = [
        _row_summary(asked, row, [e for e in episodes if e.row == row.name])
        for row in asked.rows
    ]
    more: dict[str, Any] = {}
    if asked.continuing:
        more["score_continuing"] = mean(row["score_continuing"] for row in rows)
    others = sum(_begins_elsewhere(asked, episode) for episode in episodes)
    subtasks = [subtask for episode in episodes for subtask in episode.record.subtasks]
    wanted = sum(asked.count(row) for row in asked.rows)
    return {
        "score": mean(row["score"] for row in rows),
        **more,
        "episodes": len(episodes),
        # Other starts are other episodes, whose score cannot be compared.
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
    if starts is None:
        return False
    (row,) = (row for row in asked.rows if row.name == episode.row)
    record = episode.record
    return starts[asked.place(row, record.seed, record.index)] != episode.start


def _row_summary(
    asked: Manifest, row: ScoreRow, episodes: Sequence[ScoredEpisode]
) -> dict[str, Any]:
    valid = [e for e in episodes if not (e.record.taint or e.record.error)]
    clean = [e.record for e in valid]
    won = sum(record.success_once for record in clean)
    done = won
    if not row.subtask:
        # Summed in order, so that a verifier gets the same last bit.
        done = ordered_sum(record.completed / len(record.plan) for record in clean)
    # Tainted episodes count in the denominator: they are no success, and leaving them out would pay.
    count = len(episodes)
    more: dict[str, Any] = {}
    if len(asked.seeds) > 1:
        more["score_by_seed"] = [
            _share(
                sum(record.success_once for record in clean if record.seed == seed),
                sum(e.record.seed == seed for e in episodes),
            )
            for seed in asked.seeds
        ]
    if asked.continuing:
        later = sum(bool(e.continuing) for e in valid)
        more["score_continuing"] = _share(later, count)
    return {
        **asdict(row),
        "name": row.name,
        "done": count,
        "score": _share(done, count),
        "success_once": _share(won, count),
        "interval": list(wilson(won, count)),
        **more,
    }


def _share(part: float, whole: int) -> float:
    return round(part / whole, 4) if whole else 0.0
