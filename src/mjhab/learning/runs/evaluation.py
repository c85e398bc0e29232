"""Evaluation of checkpoints during training, as by `mjhab eval`, in episodes that are never trained on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mjhab.evaluation.evaluate import EvalSpec, Run, run_evaluation
from mjhab.learning.runs.collection import Means, Scene
from mjhab.rollout.policy import RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink

EVALUATION_SEED = 7_000_000
"""Offset of the evaluations' seeds, so that they share no episode with the training data."""


@dataclass(frozen=True)
class Evaluations:
    """Scene, resources and episodes of a run's evaluations; all evaluations of a run use the same episodes.

    means: processes and threads. seed: of the run. tell: called with the number of finished episodes.
    """

    scene: Scene
    means: Means
    seed: int
    tell: Callable[[int], object] = bool

    def run(self, student: Path, episodes: int, films: int, out: Path) -> Run:
        """Evaluate a checkpoint in the episodes 0 to ``episodes`` - 1 and film the first ``films`` of them.

        Existing results in the run folder ``out`` are replaced.
        """
        scene = self.scene
        spec = EvalSpec(
            policy=str(student),
            task=scene.task,
            subtask=scene.subtask,
            target=scene.target or None,
            split=scene.split,
            assets=scene.assets,
            home=scene.home or None,
            episodes=episodes,
            worlds=self.means.worlds,
            threads=self.means.threads,
            seed=EVALUATION_SEED + self.seed,
            env=scene.apart_from_profile(),
            films=films,
            out=out,
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
