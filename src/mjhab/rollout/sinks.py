"""What listens to the rollout loop."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from mjhab.core.action_notes import ActionNotes
from mjhab.rollout.policy import RolloutEnv
from mjhab.rollout.records import EpisodeRecord

EnvT = TypeVar("EnvT", bound=RolloutEnv, contravariant=True)


@dataclass(frozen=True, eq=False)
class StepView:
    """One control step of all W worlds, after it was taken.

    ``active`` (W,) bool: worlds in which an episode runs; the rest idles and must be ignored. ``steps`` (W,) int: step
    number within the episode, the first is 1. ``done`` (W,) bool: active worlds whose episode ended in this step.
    ``actions`` (W, A) were applied; ``obs``, ``reward`` (W,) and ``info`` came back. ``notes``: which actions were
    intended, and by whom.
    """

    active: np.ndarray
    steps: np.ndarray
    done: np.ndarray
    actions: np.ndarray
    obs: Any
    reward: np.ndarray
    info: Mapping[str, Any]
    notes: ActionNotes


class Sink(Generic[EnvT]):
    """Base of all sinks: every method does nothing. A sink that asks more of the environment names it as ``EnvT``.

    ``on_begin`` comes once; then the loop calls the others in this order for each episode.
    """

    def on_begin(self, env: EnvT, episodes: Collection[int]) -> None:
        """The rollout begins; these episodes will be run. Called once, before all others."""

    def on_reset(self, env: EnvT, info: Mapping[str, Any], mask: np.ndarray) -> None:
        """New episodes began in the worlds of ``mask`` (W,) bool."""

    def on_step(self, env: EnvT, step: StepView) -> None:
        """A control step was taken; finished worlds are not reset yet."""

    def on_episode_end(self, env: EnvT, world: int, record: EpisodeRecord) -> None:
        """The episode in ``world`` is over."""

    def close(self) -> None:
        """The rollout is over or was interrupted; free what is held. Called exactly once."""
