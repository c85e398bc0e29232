"""Evaluation of checkpoints during training, as by `mjhab eval`, in episodes that are never trained on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mjhab.evaluation.evaluate import EvalSpec, Run, run_evaluation
from mjhab.evaluation.specs import SMALL_FILM
from mjhab.learning.runs.specs import Resources, Scene
from mjhab.reports.compared.trainings import FINAL, ON_THE_WAY
from mjhab.reports.metrics import mean, wilson
from mjhab.rollout.policy import RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink

EVALUATION_SEED = 7_000_000
"""Offset of the evaluations' seeds, so that they share no episode with the training data."""


GUESSED_EPISODE_SECONDS = 0.5
"""Wall time of an evaluation's episode before anything is measured [s]: 200 control steps at 400 steps/s."""
MOST_GUESSED_SHARE = 0.5
"""Largest fraction of the time budget that is reserved for evaluations on a guess."""


class EvaluationClock:
    """How much of the time budget the coming evaluations need.

    Args:
        budget: wall time of the run [s], 0 for no limit.
    """

    def __init__(self, budget: float) -> None:
        self._budget = budget
        self._episode = GUESSED_EPISODE_SECONDS
        self._is_measured = False

    def guess(self, seconds: float) -> None:
        """Set the estimated time of one episode [s]; ignored once an evaluation was measured."""
        if not self._is_measured:
            self._episode = seconds

    def measured(self, seconds: float) -> None:
        """Set the measured time of one episode [s]."""
        self._episode = seconds
        self._is_measured = True

    def needed(self, episodes: int) -> float:
        """Time that ``episodes`` take, as far as it is known [s]."""
        return self._episode * episodes

    def reserve(self, episodes: int) -> float:
        """Time to reserve for ``episodes`` [s]; on a guess never more than MOST_GUESSED_SHARE of the budget."""
        needed = self.needed(episodes)
        return (
            needed
            if self._is_measured
            # A wrong guess must not end a run before its first update.
            else min(needed, MOST_GUESSED_SHARE * self._budget)
        )


@dataclass(frozen=True)
class EvalResult:
    """Outcome of one evaluation during a run, or of none.

    split: of the homes, "" without an evaluation. samples: of the run when it began. rows: episodes by the name of
    the scene.
    """

    split: str = ""
    samples: int = 0
    rows: Mapping[str, Sequence[EpisodeRecord]] = field(default_factory=dict)

    @property
    def records(self) -> list[EpisodeRecord]:
        """Episodes of all scenes."""
        return [record for records in self.rows.values() for record in records]

    def success_by_row(self) -> dict[str, float]:
        """Success once by the name of the scene."""
        return {
            row: mean(record.success_once for record in records)
            for row, records in self.rows.items()
        }

    def summary(self) -> dict[str, Any]:
        """The part of a run's summary that this evaluation gives; everything but "episodes" is None without one."""
        records = self.records
        if not records:
            names = (
                "split",
                "success_once",
                "interval",
                "success_at_end",
                "evaluated_samples",
            )
            return {**dict.fromkeys(names), "episodes": 0}
        return {
            "split": self.split,
            "success_once": mean(record.success_once for record in records),
            "interval": list(
                wilson(sum(record.success_once for record in records), len(records))
            ),
            "success_at_end": mean(record.success_at_end for record in records),
            "episodes": len(records),
            "evaluated_samples": self.samples,
        }


def evaluation_row(
    success_once: float, episodes: int, split: str, last: bool
) -> dict[str, Any]:
    """What metrics.jsonl tells of an evaluation: success, and of what it is the success.

    Args:
        success_once: share of the episodes.
        episodes: their number, of all scenes.
        split: of their homes.
        last: whether it is the final evaluation.
    """
    return {
        "success_once": success_once,
        "evaluated_episodes": episodes,
        "evaluated_split": split,
        "evaluation": FINAL if last else ON_THE_WAY,
    }


@dataclass(frozen=True)
class Evaluations:
    """Scene, resources and episodes of a run's evaluations; all evaluations of a run use the same episodes.

    resources: processes and threads. seed: of the run. tell: called with the number of finished episodes.
    """

    scene: Scene
    resources: Resources
    seed: int
    tell: Callable[[int], object] = bool

    def run(self, student: Path, episodes: int, films: int, out: Path) -> Run:
        """Evaluate a checkpoint in the episodes 0 to ``episodes`` - 1 and film the first ``films`` of them.

        Existing results in the run folder ``out`` are replaced.
        """
        scene = self.scene
        spec = EvalSpec.of(
            policy=str(student),
            task=scene.task,
            subtask=scene.subtask,
            target=scene.target or None,
            split=scene.split,
            assets=scene.assets,
            home=scene.home or None,
            episodes=episodes,
            worlds=self.resources.worlds,
            threads=self.resources.threads,
            seed=EVALUATION_SEED + self.seed,
            env=scene.apart_from_profile(),
            films=films,
            film_size=SMALL_FILM,
            out=out,
            # An evaluation that was interrupted has left its folder.
            overwrite=True,
        )
        return run_evaluation(spec, [_Counter(self.tell)])


class _Counter(Sink[RolloutEnv]):
    """Counts finished episodes."""

    def __init__(self, tell: Callable[[int], object]) -> None:
        self._tell = tell
        self._done = 0

    def on_episode_end(self, env: RolloutEnv, world: int, record: EpisodeRecord) -> None:
        """Report one more finished episode."""
        self._done += 1
        self._tell(self._done)
