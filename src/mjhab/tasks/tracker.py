"""Follow the running subtask of every world: its events, its label, its published label.

This is the one stateful thing in ``tasks``: a notebook beside the pure functions, for whoever steps worlds.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from mjhab.core.arrays import Array, namespace, to_numpy, where_rows
from mjhab.tasks import events as ev
from mjhab.tasks import labels as lb
from mjhab.tasks.legacy import extend, legacy_label
from mjhab.tasks.plan import PADDING


@dataclass
class _Notes:
    """What is written down about one world's subtask."""

    events: list[tuple[int, str]] = field(default_factory=list)
    legacy: list[str] = field(default_factory=list)
    steps: int = 0
    success: bool = False
    at_goal_first: bool = False


class SubtaskTracker:
    """Notes on the active subtask of W worlds.

    Made with the signals at the reset. After each control step call ``step`` with the signals measured before the
    pointer moves; read ``labels``, ``legacy_label`` and ``events`` of the worlds whose subtask ended; then ``restart``
    those with signals measured after the pointer has moved.
    """

    def __init__(self, signals: lb.Watched) -> None:
        self._previous = _row(signals)
        self._labels = lb.start(signals)
        self._notes = [_Notes() for _ in range(signals.success.shape[0])]

    def restart(self, mask: Array, signals: lb.Watched) -> None:
        """Begin a new subtask in the worlds of ``mask`` (W,) bool, from the signals at its start."""
        self._previous = where_rows(mask, _row(signals), self._previous)
        self._labels = lb.restart(self._labels, mask, signals)
        for w in to_numpy(mask).nonzero()[0].tolist():
            self._notes[w] = _Notes()

    def step(self, kind: Array, signals: lb.Watched, step: Array, live: Array | None = None) -> list[list[str]]:
        """Add one control step.

        Args:
            kind: (W,) int64 kinds of the active subtasks.
            signals: measured after the step.
            step: (W,) int64 number of the step, written beside the events.
            live: (W,) bool, False for worlds that are done and only wait for their reset; they are left alone.

        Returns:
            Names of this step's events per world.
        """
        labels = lb.update(self._labels, signals)
        if live is not None:
            kind = namespace(kind).where(live, kind, PADDING)
            labels = where_rows(live, labels, self._labels)
        self._labels = labels
        current = _row(signals)
        names = ev.event_names(kind, ev.step_events(kind, self._previous, current))
        self._write(kind, names, current, to_numpy(step))
        self._previous = current
        return names

    def _write(self, kind: Array, names: list[list[str]], current: lb.History, step: np.ndarray) -> None:
        """Write the step's events into the notes; the published labels see the first step as if from nothing."""
        kinds, success, at_goal = to_numpy(kind), to_numpy(current.success), to_numpy(current.at_goal)
        first_names: list[list[str]] | None = None
        for w, note in enumerate(self._notes):
            if kinds[w] < 0:
                continue
            legacy_names = names[w]
            if note.steps == 0:
                if first_names is None:
                    first_names = ev.event_names(kind, ev.step_events(kind, ev.blank(current), current))
                legacy_names = first_names[w]
                note.at_goal_first = bool(at_goal[w])
            extend(note.legacy, int(kinds[w]), legacy_names)
            note.events.extend((int(step[w]), name) for name in names[w])
            note.success |= bool(success[w])
            note.steps += 1

    def labels(self, kind: Array) -> list[str]:
        """Return the label every world's subtask would have if it ended now."""
        return lb.label_names(kind, lb.label(self._labels, kind))

    def legacy_label(self, w: int, kind: int) -> str:
        """Return the published label of world ``w``'s subtask if it ended now."""
        note = self._notes[w]
        return legacy_label(kind, note.legacy, note.success, note.at_goal_first)

    def events(self, w: int) -> list[tuple[int, str]]:
        """Return the (step, name) events of world ``w``'s subtask so far."""
        return list(self._notes[w].events)


def _row(signals: lb.Watched) -> lb.History:
    """Keep only what events look at."""
    return lb.History(**{f.name: getattr(signals, f.name) for f in dataclasses.fields(lb.History)})
