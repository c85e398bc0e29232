"""What the vector environments of the backends do in their own ways; `envs.loop` does the rest of a control step."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol

from gymnasium.vector import VectorEnv

from mjhab.core.arrays import Array
from mjhab.envs.parts.observing import ObservedRows
from mjhab.envs.parts.plan_tables import Tables
from mjhab.tasks.progress import Progress, StepOutcome
from mjhab.tasks.signals import Signals


class StepEvents(Protocol):
    """Events of one control step, and the records of subtasks that ended in it, as entries of `info`."""

    def entries(self) -> dict[str, Any]:
        """Entries of `info`."""
        ...


class SubtaskNotes(Protocol):
    """Signals of the active subtask of every world, collected for its label and events."""

    def begin(self, mask: Any, signals: Signals, progress: Progress) -> None:
        """Discard the notes of the worlds in ``mask`` (W,) bool; begin with the signals at their subtask's start."""
        ...


class BackendWorlds(VectorEnv, ABC):
    """W worlds of a backend."""

    sim: Any
    """Simulator of the worlds: a `CpuSimulator`, on a device a `WarpSimulator`."""
    observer: ObservedRows
    tables: Tables
    tracker: SubtaskNotes

    @abstractmethod
    def _reseed(self, seed: Any, mask: Array) -> None:
        """Set the seed of the next episodes in the worlds of ``mask`` (W,); None keeps the present one."""

    @abstractmethod
    def _next_episodes(self) -> Array:
        """(W,) int64: index of the episode that each world begins at its next automatic reset."""

    @abstractmethod
    def _chosen_episodes(self, wanted: Any, mask: Array) -> Array:
        """Scatter the episode indices ``wanted``, one per world of ``mask``, to an array (W,) int64, and check them."""

    @abstractmethod
    def _adopt(self, fresh: Array, episodes: Array) -> None:
        """Set all data of an episode in the worlds ``fresh`` (W,) to those of ``episodes`` (W,): rows of ``tables``,
        ``fallback`` and so on."""

    @abstractmethod
    def _place(self, fresh: Array, moved: Array) -> Array:
        """Set the physics of worlds to the start state of their subtask.

        Args:
            fresh: (W,) bool, worlds that begin an episode.
            moved: (W,) bool, worlds that begin the next subtask of their episode, none of them ``fresh``.

        Returns:
            (W,) bool, worlds whose physics state was changed.
        """

    @abstractmethod
    def _checked(self, actions: Any) -> Array:
        """Check shape and type of the actions and return a copy (W, A) float32."""

    @abstractmethod
    def _simulate(self, ctrl: Array) -> Array:
        """Advance physics under ``ctrl`` (W, nu).

        Returns:
            (W,) bool, worlds whose state became NaN or infinite and was set back to that before the step.
        """

    @abstractmethod
    def _note(
        self, signals: Signals, outcome: StepOutcome, progress: Progress
    ) -> StepEvents:
        """Update the tracker with a step and its ``outcome``; ``progress`` is that before the pointer advances."""

    @abstractmethod
    def _nothing(self) -> StepEvents:
        """Notes of a step without events and without ended subtasks."""

    @abstractmethod
    def _observe(
        self, known: dict[str, Array] | None = None, changed: Array | None = None
    ) -> dict:
        """Observations of the present state.

        Args:
            known: observations from earlier in this step.
            changed: (W,) bool, worlds whose physics state has changed since; only their images are rendered again.
        """
