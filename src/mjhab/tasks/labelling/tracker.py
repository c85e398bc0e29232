"""Tracking of the active subtask of every world: its events, its label, its published label.

`SubtaskTracker` is the only class in ``tasks`` with state; all other modules are pure functions.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mjhab.core.arrays import Array, may_hold, namespace, to_numpy
from mjhab.tasks import label_state as lb
from mjhab.tasks.labelling import events as ev
from mjhab.tasks.labelling.labels import label, label_names
from mjhab.tasks.labelling.legacy import extend, legacy_label
from mjhab.tasks.subtasks.registry import PADDING

_SUCCESS = lb.WATCHED.index("success")
_AT_GOAL = lb.WATCHED.index("at_goal")


@dataclass
class _Notes:
    """Events of one world's subtask: (step, name) pairs, and the event list of the published labels."""

    events: list[tuple[int, str]] = field(default_factory=list)
    legacy: list[str] = field(default_factory=list)


class SubtaskTracker:
    """Tracks the active subtask of W worlds.

    After each control step call ``step`` with the signals measured before the pointer moves; read ``labels``,
    ``legacy_label`` and ``events`` of the worlds whose subtask ended; then ``restart`` these with the signals measured
    after the pointer has moved.

    Args:
        signals: signals (W,) at the reset.
    """

    def __init__(self, signals: lb.Watched) -> None:
        self._labels = lb.start(signals)
        count = signals.success.shape[0]
        self._notes = [_Notes() for _ in range(count)]
        self._begun, self._success, self._at_goal_first = np.zeros((3, count), bool)

    def restart(self, mask: Array, signals: lb.Watched) -> None:
        """Begin a new subtask in the worlds of ``mask`` (W,) bool, from the signals at its start."""
        self._labels = lb.restart(self._labels, mask, signals)
        rows = to_numpy(mask)
        for w in rows.nonzero()[0].tolist():
            self._notes[w] = _Notes()
        self._begun[rows] = self._success[rows] = self._at_goal_first[rows] = False

    def get_row(self, w: int) -> dict[str, Any]:
        """Copy of the state of world ``w`` as plain data and arrays."""
        return {
            "labels": lb.get_row(self._labels, w),
            "events": [[step, name] for step, name in self._notes[w].events],
            "legacy": list(self._notes[w].legacy),
            "flags": [
                bool(rows[w])
                for rows in (self._begun, self._success, self._at_goal_first)
            ],
        }

    def set_row(self, w: int, row: dict[str, Any]) -> None:
        """Restore world ``w`` from ``get_row``."""
        self._labels = lb.set_row(self._labels, w, row["labels"])
        self._notes[w] = _Notes(
            [(int(step), str(name)) for step, name in row["events"]], list(row["legacy"])
        )
        self._begun[w], self._success[w], self._at_goal_first[w] = row["flags"]

    def step(
        self, kind: Array, signals: lb.Watched, step: Array, live: Array | None = None
    ) -> list[list[str]]:
        """Add one control step.

        Args:
            kind: (W,) int64 kinds of the active subtasks.
            signals: measured after the step.
            step: (W,) int64 number of the step, stored with the events.
            live: (W,) bool, False for worlds that are done and wait for their reset; they are not changed.

        Returns:
            Names of this step's events per world.
        """
        before = self._labels.now
        now = lb.watch(signals)
        # The first step counts even if nothing changed: published labels begin from False.
        if not may_hold(~self._begun) and not may_hold(to_numpy(before ^ now)):
            # No check changed in any world: there are no events, and the state stays the same.
            return [[] for _ in self._notes]
        labels = lb.add(self._labels, now)
        if live is not None:
            # A kind without events, so that worlds that are done notice none.
            kind = namespace(kind).where(live, kind, PADDING)
            labels = lb.choose(live, labels, self._labels)
        self._labels = labels
        names = ev.event_names(kind, ev.edge_events(kind, before, now))
        self._write(to_numpy(kind), names, to_numpy(now), to_numpy(step))
        return names

    def _write(
        self, kinds: np.ndarray, names: list[list[str]], now: np.ndarray, step: np.ndarray
    ) -> None:
        """Store the step's events; for the published labels all checks count as False before the first step."""
        live = kinds >= 0
        self._success |= live & now[_SUCCESS]
        first = live & ~self._begun
        legacy_names = names
        if first.any():
            self._begun |= live
            from_nothing = ev.event_names(
                # As if nothing had held before: that is what the published rules assume.
                kinds,
                ev.edge_events(kinds, np.zeros_like(now), now),
            )
            legacy_names = [
                from_nothing[w] if first[w] else names[w] for w in range(len(names))
            ]
            self._at_goal_first = np.where(first, now[_AT_GOAL], self._at_goal_first)
        for w, note in enumerate(self._notes):
            # Both, because only one of them has events of the start state.
            if names[w] or legacy_names[w]:
                extend(note.legacy, int(kinds[w]), legacy_names[w])
                note.events.extend((int(step[w]), name) for name in names[w])

    def labels(self, kind: Array) -> list[str]:
        """Return the label every world's subtask would have if it ended now."""
        return label_names(kind, label(self._labels, kind))

    def legacy_label(self, w: int, kind: int) -> str | None:
        """The published label of world ``w``'s subtask if it ended now; None if it has none."""
        note = self._notes[w]
        return legacy_label(
            kind, note.legacy, bool(self._success[w]), bool(self._at_goal_first[w])
        )

    def events(self, w: int) -> list[tuple[int, str]]:
        """Return the (step, name) events of world ``w``'s subtask so far."""
        return list(self._notes[w].events)
