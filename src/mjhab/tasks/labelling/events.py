"""Events of a control step: named edges between the signals of two consecutive steps.

Names and meaning follow mshab/utils/label_dataset.py; ``contact`` and ``grasped`` come from the fingers only.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import numpy as np

from mjhab.core.arrays import Array, Table, constant, count, namespace, to_numpy
from mjhab.tasks.label_state import WATCHED, History, Watched, watch
from mjhab.tasks.subtasks.registry import SUBTASKS, check_kinds, event_columns, spec_of
from mjhab.tasks.subtasks.spec import EDGES


# By the version of the registry: a plugin that adds a kind changes the table.
@lru_cache(maxsize=8)
def _edge_index(version: int) -> Table:
    """(K + 1, E): row of EDGES that is the event of a column, for every kind; for kind -1 nothing occurs."""
    columns = event_columns()
    none = EDGES.index("none")
    rows = (
        tuple(EDGES.index(spec.edge(name)) for name in columns)
        for spec in SUBTASKS.values()
    )
    return Table((*rows, (none,) * len(columns)))


_GRASPED = WATCHED.index("is_grasped")
_AT_GOAL = WATCHED.index("at_goal")


def blank(signals: Watched) -> History:
    """Signals that mshab/utils/label_dataset.py assumes before the first action: all False, force within its limit."""
    no = signals.success & ~signals.success
    return History(
        **{
            f.name: ~no if f.name == "force_ok" else no
            for f in dataclasses.fields(History)
        }
    )


def step_events(kind: Array, previous: Watched, current: Watched) -> Array:
    """Flag the events of one step.

    Args:
        kind: (W,) int64 kinds of the active subtasks; -1 has no events.
        previous: signals of a step.
        current: signals of the next step of the same subtask.

    Returns:
        (W, E) bool with the columns `event_columns`.
    """
    return edge_events(kind, watch(previous), watch(current))


def edge_events(kind: Array, before: Array, now: Array) -> Array:
    """`step_events` (W, E) bool of two consecutive watched steps, each (K, W) bool with the rows ``WATCHED``."""
    check_kinds(kind)
    # Once for both directions, since this runs in every control step.
    changed = before ^ now
    rise = changed & now
    fall = changed & before
    release = fall[_GRASPED][None]
    at_goal = now[_AT_GOAL][None]
    edges = namespace(kind).concat(
        # The last row can never hold: it is the edge of columns that a kind does not have.
        (rise, fall, release & at_goal, release & ~at_goal, rise[:1] & fall[:1])
    )
    # (W, E): for every world the edges that are events of its kind.
    return edges[
        constant(_edge_index(SUBTASKS.version), kind)[kind],
        count(kind.shape[0], kind)[:, None],
    ]


def event_names(kind: Array, flags: Array) -> list[list[str]]:
    """Names of the flagged events (W, E) of every world, in the order of ``events`` of its kind's `SubtaskSpec`."""
    table = to_numpy(flags)
    names: list[list[str]] = [[] for _ in range(table.shape[0])]
    kinds = to_numpy(kind)
    columns = {name: column for column, name in enumerate(event_columns())}
    # In most steps nothing happens in most worlds.
    for w in np.flatnonzero(table.any(axis=1)).tolist():
        events = spec_of(int(kinds[w])).events
        names[w] = [name for name in events if table[w, columns[name]]]
    return names
