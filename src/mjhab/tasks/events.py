"""What happened in a step: named events as edges between the signals of two consecutive steps.

Names and meaning follow mshab/utils/label_dataset.py; ``contact`` and ``grasped`` come from the fingers only.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from mjhab.core.arrays import Array, Table, constant, count, namespace, to_numpy
from mjhab.tasks.labels import WATCHED, History, Watched, watch
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
    SubtaskKind.NAVIGATE: (
        "navigated_close",
        "grasped",
        "dropped",
        "success",
        "excessive_collisions",
    ),
    SubtaskKind.OPEN: (
        "contact",
        "opened",
        "success",
        "excessive_collisions",
        "slightly_opened",
        "closed",
    ),
    SubtaskKind.CLOSE: (
        "contact",
        "closed",
        "success",
        "excessive_collisions",
        "slightly_closed",
        "opened",
    ),
}
"""Events the published labels count, in the order they are listed within one step."""

_MORE: dict[SubtaskKind, tuple[str, ...]] = {
    SubtaskKind.PICK: ("lost_contact", "lost_success"),
    SubtaskKind.PLACE: ("lost_success",),
    SubtaskKind.NAVIGATE: ("lost_navigated_close", "lost_success"),
    SubtaskKind.OPEN: ("lost_contact", "lost_success"),
    SubtaskKind.CLOSE: ("lost_contact", "lost_success"),
}
EVENTS: dict[SubtaskKind, tuple[str, ...]] = {
    kind: LABEL_EVENTS[kind] + _MORE[kind] for kind in SubtaskKind
}
"""Every event a kind of subtask can have, in the order they are listed within one step."""

_COLUMNS = {int(k): [(EVENT_NAMES.index(name), name) for name in EVENTS[k]] for k in SubtaskKind}

_EDGES = (
    *(f"+{name}" for name in WATCHED),
    *(f"-{name}" for name in WATCHED),
    "released_at_goal",
    "released_outside_goal",
    "none",
)
"""Rows of the edges of a step: every watched signal rises (+) and falls (-), then the two kinds of release."""
_EDGE_OF = {
    "contact": "+contact",
    "lost_contact": "-contact",
    "grasped": "+is_grasped",
    "dropped": "-is_grasped",
    "at_goal": "+at_goal",
    "released_at_goal": "released_at_goal",
    "released_outside_goal": "released_outside_goal",
    "left_goal": "-at_goal",
    "navigated_close": "+near",
    "lost_navigated_close": "-near",
    "opened": "+opened",
    "slightly_opened": "+slightly_opened",
    "closed": "+closed",
    "slightly_closed": "+slightly_closed",
    "success": "+success",
    "lost_success": "-success",
    "excessive_collisions": "+excess",
}
_BACK = {
    (SubtaskKind.OPEN, "closed"): "-slightly_opened",
    (SubtaskKind.CLOSE, "opened"): "-slightly_closed",
}
"""In an Open, ``closed`` means that the joint fell back to no more than 10 % of its range; in a Close, ``opened`` means
that it went back to within 5 % of its range of the start. All other events are edges of the signal named."""


def _edge(kind: SubtaskKind, name: str) -> int:
    """Row of the edge that is an event of a subtask of ``kind``."""
    edge = _BACK.get((kind, name), _EDGE_OF[name]) if name in EVENTS[kind] else "none"
    return _EDGES.index(edge)


# Kind -1 reads the last row: nothing occurs.
_EDGE_INDEX = Table(
    (
        *(tuple(_edge(kind, name) for name in EVENT_NAMES) for kind in SubtaskKind),
        (_EDGES.index("none"),) * len(EVENT_NAMES),
    )
)
_GRASPED = WATCHED.index("is_grasped")
_AT_GOAL = WATCHED.index("at_goal")


def blank(signals: Watched) -> History:
    """The state mshab/utils/label_dataset.py assumes before the first action: nothing holds, no force spent."""
    no = signals.success & ~signals.success
    return History(
        **{f.name: ~no if f.name == "force_ok" else no for f in dataclasses.fields(History)}
    )


def step_events(kind: Array, previous: Watched, current: Watched) -> Array:
    """Flag the events of one step.

    Args:
        kind: (W,) int64 kinds of the active subtasks; -1 has no events.
        previous, current: signals of two consecutive steps of the same subtask.

    Returns:
        (W, E) bool with the columns ``EVENT_NAMES``.
    """
    return edge_events(kind, watch(previous), watch(current))


def edge_events(kind: Array, before: Array, now: Array) -> Array:
    """``step_events`` of two consecutive watched steps, (K, W) bool each with the rows ``WATCHED``."""
    changed = before ^ now
    rise = changed & now
    fall = changed & before
    release = fall[_GRASPED][None]
    at_goal = now[_AT_GOAL][None]
    edges = namespace(kind).concat(
        (rise, fall, release & at_goal, release & ~at_goal, rise[:1] & fall[:1])
    )
    # (W, E): for every world the edges that are events of its kind.
    return edges[constant(_EDGE_INDEX, kind)[kind], count(kind.shape[0], kind)[:, None]]


def event_names(kind: Array, flags: Array) -> list[list[str]]:
    """Return the names of the flagged events (W, E) of every world, in the order of ``EVENTS`` of its kind."""
    table = to_numpy(flags)
    names: list[list[str]] = [[] for _ in range(table.shape[0])]
    kinds = to_numpy(kind)
    for w in np.flatnonzero(table.any(axis=1)).tolist():
        names[w] = [name for column, name in _COLUMNS[int(kinds[w])] if table[w, column]]
    return names
