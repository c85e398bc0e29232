"""What happened in a step: named events as edges between the signals of two consecutive steps.

Names and meaning follow mshab/utils/label_dataset.py; ``contact`` and ``grasped`` come from the fingers only.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from mjhab.core.arrays import Array, constant, namespace, to_numpy
from mjhab.tasks.labels import History, Watched
from mjhab.tasks.plan import SubtaskKind

EVENT_NAMES: tuple[str, ...] = (
    "contact",
    "lost_contact",
    "grasped",
    "dropped",
    "at_goal",
    "released_at_goal",
    "released_outside_goal",
    "left_goal",
    "navigated_close",
    "lost_navigated_close",
    "opened",
    "slightly_opened",
    "closed",
    "slightly_closed",
    "success",
    "lost_success",
    "excessive_collisions",
)
"""Columns of the event flags."""

LABEL_EVENTS: dict[SubtaskKind, tuple[str, ...]] = {
    SubtaskKind.PICK: ("contact", "grasped", "dropped", "success", "excessive_collisions"),
    SubtaskKind.PLACE: (
        "grasped",
        "at_goal",
        "released_at_goal",
        "released_outside_goal",
        "left_goal",
        "success",
        "excessive_collisions",
    ),
    SubtaskKind.NAVIGATE: ("navigated_close", "grasped", "dropped", "success", "excessive_collisions"),
    SubtaskKind.OPEN: ("contact", "opened", "success", "excessive_collisions", "slightly_opened", "closed"),
    SubtaskKind.CLOSE: ("contact", "closed", "success", "excessive_collisions", "slightly_closed", "opened"),
}
"""Events the published labels count, in the order they are listed within one step."""

_MORE: dict[SubtaskKind, tuple[str, ...]] = {
    SubtaskKind.PICK: ("lost_contact", "lost_success"),
    SubtaskKind.PLACE: ("lost_success",),
    SubtaskKind.NAVIGATE: ("lost_navigated_close", "lost_success"),
    SubtaskKind.OPEN: ("lost_contact", "lost_success"),
    SubtaskKind.CLOSE: ("lost_contact", "lost_success"),
}
EVENTS: dict[SubtaskKind, tuple[str, ...]] = {kind: LABEL_EVENTS[kind] + _MORE[kind] for kind in SubtaskKind}
"""Every event a kind of subtask can have, in the order they are listed within one step."""

_OCCURS = tuple(tuple(name in EVENTS[kind] for name in EVENT_NAMES) for kind in SubtaskKind)
_NOTHING = (False,) * len(EVENT_NAMES)
_COLUMNS = {int(k): [(EVENT_NAMES.index(name), name) for name in EVENTS[k]] for k in SubtaskKind}


def blank(signals: Watched) -> History:
    """The state mshab/utils/label_dataset.py assumes before the first action: nothing holds, no force spent."""
    no = signals.success & ~signals.success
    return History(**{f.name: ~no if f.name == "force_ok" else no for f in dataclasses.fields(History)})


def step_events(kind: Array, previous: Watched, current: Watched) -> Array:
    """Flag the events of one step.

    In an Open, ``closed`` means that the joint fell back to no more than 10 % of its range; in a Close, ``opened``
    means that it went back to within 5 % of its range of the start. All others are edges of the signal named.

    Args:
        kind: (W,) int64 kinds of the active subtasks; -1 has no events.
        previous, current: signals of two consecutive steps of the same subtask.

    Returns:
        (W, E) bool with the columns ``EVENT_NAMES``.
    """
    xp = namespace(kind)
    p, c = previous, current
    opening, closing = kind == int(SubtaskKind.OPEN), kind == int(SubtaskKind.CLOSE)
    release = p.is_grasped & ~c.is_grasped
    open_again, closed_again = p.slightly_closed & ~c.slightly_closed, p.slightly_opened & ~c.slightly_opened
    columns = [
        ~p.contact & c.contact,
        p.contact & ~c.contact,
        ~p.is_grasped & c.is_grasped,
        release,
        ~p.at_goal & c.at_goal,
        release & c.at_goal,
        release & ~c.at_goal,
        p.at_goal & ~c.at_goal,
        ~p.near & c.near,
        p.near & ~c.near,
        (opening & ~p.opened & c.opened) | (closing & open_again),
        ~p.slightly_opened & c.slightly_opened,
        (closing & ~p.closed & c.closed) | (opening & closed_again),
        ~p.slightly_closed & c.slightly_closed,
        ~p.success & c.success,
        p.success & ~c.success,
        p.force_ok & ~c.force_ok,
    ]
    # Kind -1 reads the last row: nothing occurs.
    occurs = constant((*_OCCURS, _NOTHING), current.success)[kind]
    return xp.stack(columns, axis=-1) & occurs


def event_names(kind: Array, flags: Array) -> list[list[str]]:
    """Return the names of the flagged events (W, E) of every world, in the order of ``EVENTS`` of its kind."""
    table = to_numpy(flags)
    names: list[list[str]] = [[] for _ in range(table.shape[0])]
    kinds = to_numpy(kind)
    for w in np.flatnonzero(table.any(axis=1)).tolist():
        names[w] = [name for column, name in _COLUMNS[int(kinds[w])] if table[w, column]]
    return names
