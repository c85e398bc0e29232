"""Evaluating a student while it is trained, through THE rollout loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mjhab.learning.collection import Means, Scene, make_env
from mjhab.learning.policy import StudentPolicy
from mjhab.learning.student import Student
from mjhab.rollout.loop import rollout
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink

EVALUATION_SEED = 7_000_000
"""Seeds of evaluations begin here: no episode of collection is one of them."""


class Evaluator:
    """Rolls out a student in the environment that it is judged in, which is made when it is first needed.

    Args:
        scene: where. view: options of the environment that show the student what it sees. means: on what.
        seed: of the run; evaluations of a run all have the same episodes.
    """

    def __init__(self, scene: Scene, view: dict[str, Any], means: Means, seed: int) -> None:
        self._scene, self._view, self._means, self._seed = scene, view, means, seed
        self._env: Any = None

    @property
    def env(self) -> Any:
        """The environment."""
        if self._env is None:
            self._env = make_env(self._scene, self._view, self._means)
        return self._env

    def evaluate(self, student: Student, episodes: Sequence[int], sinks: Sequence[Sink] = ()) -> list[EpisodeRecord]:
        """Records of the named episodes."""
        policy = StudentPolicy(student, self.env, self._seed)
        return rollout(self.env, policy, episodes, EVALUATION_SEED + self._seed, sinks)
