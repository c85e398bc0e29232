"""Records of subtasks at their end: label, events, forces, times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mjhab.core.arrays import may_hold, object_array
from mjhab.tasks.labelling.tracker import SubtaskTracker
from mjhab.tasks.plan import TaskPlan
from mjhab.tasks.progress import Progress, StepOutcome
from mjhab.tasks.signals import Signals
from mjhab.tasks.subtasks.registry import name_of, spec_of


@dataclass(frozen=True)
class StepNotes:
    """Events of every world in one control step, and the record of a subtask that ended in it, else None."""

    events: list[list[str]]
    ended: list[dict[str, Any] | None]

    def entries(self) -> dict[str, Any]:
        """Entries of `info`, (W,) arrays of objects."""
        return {"events": object_array(self.events), "ended": object_array(self.ended)}


class Tracker:
    """Collects signals of every world's active subtask and makes its record at the end.

    Args:
        num_worlds: W.
        teleports: the environment does Navigate by teleport, which the records tell.
    """

    def __init__(self, num_worlds: int, teleports: bool = False) -> None:
        self._num_worlds = num_worlds
        self._teleports = teleports
        self._notes: SubtaskTracker | None = None
        self._start_step = np.zeros(num_worlds, np.int64)

    def begin(self, mask: np.ndarray, signals: Signals, progress: Progress) -> None:
        """Start collecting anew in the worlds of ``mask`` (W,) with the signals at the start of their subtask."""
        if self._notes is None:
            self._notes = SubtaskTracker(signals)
        else:
            self._notes.restart(mask, signals)
        self._start_step = np.where(mask, progress.episode_step, self._start_step)

    def get_state(self, world: int) -> dict[str, Any]:
        """Copy of the collected data of a world."""
        assert self._notes is not None
        return {"start_step": int(self._start_step[world]), **self._notes.get_row(world)}

    def set_state(self, world: int, state: dict[str, Any]) -> None:
        """Restore the data of a world from `get_state`."""
        assert self._notes is not None
        self._start_step[world] = state["start_step"]
        self._notes.set_row(world, state)

    def update(self, signals: Signals, progress: Progress) -> list[list[str]]:
        """Add one control step, before the pointer advances; returns the names of its events per world."""
        assert self._notes is not None
        # None spares the choosing where all worlds run.
        live = ~progress.done if may_hold(progress.done) else None
        return self._notes.step(signals.kind, signals, progress.episode_step, live)

    def ended(
        self,
        signals: Signals,
        outcome: StepOutcome,
        progress: Progress,
        plans: list[TaskPlan],
    ) -> list[dict[str, Any] | None]:
        """Records of the subtasks that ended in this step; ``progress`` is the one before the pointer moved."""
        records: list[dict[str, Any] | None] = [None] * self._num_worlds
        # In most steps nothing ends.
        if not may_hold(outcome.ended):
            return records
        assert self._notes is not None
        labels = self._notes.labels(signals.kind)
        for w in np.flatnonzero(outcome.ended).tolist():
            kind = int(signals.kind[w])
            index = int(progress.pointer[w])
            records[w] = {
                "index": index,
                "kind": name_of(kind),
                "target": plans[w].subtasks[index].target,
                "label": labels[w],
                "legacy_label": self._notes.legacy_label(w, kind),
                "success_once": bool(outcome.success_once[w]),
                "success_at_end": bool(outcome.success_at_end[w]),
                "start_step": int(self._start_step[w]),
                "end_step": int(progress.episode_step[w]),
                "peak_force": round(float(progress.peak_force[w]), 3),
                "peak_finger_force": round(float(progress.peak_finger_force[w]), 3),
                "cumulative_force": round(float(progress.cumulative_force[w]), 3),
                "events": [[step, name] for step, name in self._notes.events(w)],
                "teleported": self._teleports and spec_of(kind).navigates,
            }
        return records
