"""The labels of the published code, for comparison with its tables: counts and orders over an event list.

Rules of mshab/utils/label_dataset.py, kept with their overlaps and gaps (for instance, a Place that grasps once more at
its goal has more than four events and is labelled ``winding_success``, wherever the object was). They read only the
steps after the first action, and events count as if nothing had held before. The baseline of a Close is the joint at
its start, q(0): the joint is ``slightly_closed`` from q(0) - 5 % of its range on, and ``opened`` when it is back above
that. Two differences remain: thresholds include equality, as everywhere here, and q(0) is that of the start state
(``WorldState.joint_start``), where the published code takes the one after the first action.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from mjhab.core.arrays import map_record, to_numpy
from mjhab.tasks.label_state import History
from mjhab.tasks.labelling.events import blank, event_names, step_events
from mjhab.tasks.subtasks.registry import spec_of


def extend(events: list[str], kind: int, names: Iterable[str]) -> None:
    """Append the names a kind counts to its event list, dropping immediate repeats. Changes ``events``."""
    published = spec_of(kind).published
    counted = () if published is None else published.events
    for name in names:
        if name in counted and (not events or events[-1] != name):
            events.append(name)


def legacy_label(
    kind: int, events: Sequence[str], success: bool, at_goal_first: bool = False
) -> str | None:
    """Label a subtask from its event list; None if the published code has no such subtask.

    Args:
        kind: the kind of subtask.
        events: made with ``extend`` from the steps after the first action on.
        success: the subtask was achieved in some step.
        at_goal_first: Place: the object was at its goal after the first action.
    """
    published = spec_of(kind).published
    return None if published is None else published.label(events, success, at_goal_first)


def legacy_history(kind: int, history: History) -> list[str | None]:
    """Label recorded subtasks of one kind.

    Args:
        kind: the kind of all of them.
        history: (T+1, W) signals; row 0, the start state, is not looked at, as in the published code.
    """
    history = map_record(to_numpy, history)
    # Without the start state, which the published code never sees.
    success = history.success[1:].any(axis=0)
    labels = []
    for w, found in enumerate(legacy_events(kind, history)):
        events: list[str] = []
        extend(events, kind, (name for _, name in found))
        there = bool(history.at_goal[1, w])
        labels.append(legacy_label(kind, events, bool(success[w]), there))
    return labels


def legacy_events(kind: int, history: History) -> list[list[tuple[int, str]]]:
    """Events of recorded subtasks of one kind, as if nothing had held before the first action: (step, name) by world.

    Steps count from 1, the first action. Arguments as in `legacy_history`.
    """
    history = map_record(to_numpy, history)
    steps, worlds = history.success.shape
    events: list[list[tuple[int, str]]] = [[] for _ in range(worlds)]
    kinds = np.full(worlds, int(kind), dtype=np.int64)
    previous = blank(history.row(0))
    for t in range(1, steps):
        current = history.row(t)
        for w, names in enumerate(
            event_names(kinds, step_events(kinds, previous, current))
        ):
            events[w] += [(t, name) for name in names]
        previous = current
    return events
