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
from mjhab.tasks.events import LABEL_EVENTS, blank, event_names, step_events
from mjhab.tasks.labels import History
from mjhab.tasks.plan import SubtaskKind

EXCESS = "excessive_collisions"


def extend(events: list[str], kind: int, names: Iterable[str]) -> None:
    """Append the names a kind counts to its event list, dropping immediate repeats. Changes ``events``."""
    counted = LABEL_EVENTS[SubtaskKind(kind)]
    for name in names:
        if name in counted and (not events or events[-1] != name):
            events.append(name)


def _last(events: Sequence[str], name: str) -> int:
    """Index of the last occurrence, -1 if there is none."""
    return max((i for i, event in enumerate(events) if event == name), default=-1)


def legacy_label(
    kind: int, events: Sequence[str], success: bool, at_goal_first: bool = False
) -> str:
    """Label a subtask from its event list.

    Args:
        kind: the kind of subtask.
        events: made with ``extend`` from the steps after the first action on.
        success: the subtask was achieved in some step.
        at_goal_first: Place: the object was at its goal after the first action.
    """
    events = list(events)
    if kind == SubtaskKind.PICK:
        return _pick(events, success)
    if kind == SubtaskKind.PLACE:
        return (
            _place_success(events, at_goal_first)
            if success
            else _place_failure(events, at_goal_first)
        )
    if kind == SubtaskKind.NAVIGATE:
        return _navigate(events, success)
    return _joint(SubtaskKind(kind), events, success)


def _pick(events: list[str], success: bool) -> str:
    if success:
        if len(events) == 3:
            return "straightforward_success"
        if len(events) > 3 and events[-1] == "success":
            return "winding_success"
        if len(events) > 3 and EXCESS not in events:
            return "success_then_drop"
        return "success_then_excessive_collisions"
    if EXCESS in events:
        return "excessive_collision_failure"
    if not events:
        return "mobility_failure"
    if len(events) == 1:
        return "cant_grasp_failure"
    return "drop_failure" if "dropped" in events and events[-1] != "grasped" else "too_slow_failure"


def _place_success(events: list[str], at_goal_first: bool) -> str:
    if EXCESS in events:
        return "success_then_excessive_collisions"
    if _last(events, "at_goal") < _last(events, "left_goal"):
        return "dubious_success"
    if len(events) <= 4 and ("released_at_goal" in events or at_goal_first):
        return "placed_in_goal_success"
    if len(events) <= 4 and ("released_outside_goal" in events or not at_goal_first):
        return "dropped_to_goal_success"
    return "winding_success"


def _place_failure(events: list[str], at_goal_first: bool) -> str:
    if EXCESS in events:
        return "excessive_collision_failure"
    if not events:
        return "didnt_grasp_failure"
    if "at_goal" not in events:
        return "didnt_reach_goal_failure"
    grasp = _last(events, "grasped")
    inside = _last(events, "released_at_goal")
    outside = _last(events, "released_outside_goal")
    placed = (len(events) <= 2 and at_goal_first) or (inside > outside and inside > grasp)
    dropped = (len(events) <= 2 and not at_goal_first) or (outside > inside and outside > grasp)
    left = _last(events, "left_goal") > _last(events, "at_goal")
    if placed and left:
        return "place_in_goal_failure"
    if dropped and left:
        return "drop_to_goal_failure"
    return "wont_let_go_failure" if grasp > max(inside, outside) else "too_slow_failure"


def _navigate(events: list[str], success: bool) -> str:
    if EXCESS in events:
        return "success_then_excessive_collisions" if success else "excessive_collision_failure"
    if "dropped" in events:
        return "success_then_dropped" if success else "dropped_failure"
    return "navigation_success" if success else "navigation_failure"


def _joint(kind: SubtaskKind, events: list[str], success: bool) -> str:
    opening = kind == SubtaskKind.OPEN
    there = _last(events, "opened" if opening else "closed")
    back = _last(events, "closed" if opening else "opened")
    slightly = _last(events, "slightly_opened" if opening else "slightly_closed")
    if success:
        if EXCESS in events:
            return "success_then_excessive_collisions"
        if back > there:
            return "dubious_success"
        return "open_success" if opening else "closed_success"
    if EXCESS in events:
        return "excessive_collision_failure"
    if "contact" not in events:
        return "cant_reach_articulation_failure"
    if back > there and back > slightly:
        return "closed_after_open_failure" if opening else "open_after_closing_failure"
    if slightly > there:
        return "slightly_open_failure" if opening else "slightly_closed_failure"
    if there >= 0:
        return "too_slow_failure"
    return "cant_open_failure" if opening else "cant_close_failure"


def legacy_history(kind: int, history: History) -> list[str]:
    """Label recorded subtasks of one kind.

    Args:
        kind: the kind of all of them.
        history: (T+1, W) signals; row 0, the start state, is not looked at, as in the published code.
    """
    history = map_record(to_numpy, history)
    steps, worlds = history.success.shape
    events: list[list[str]] = [[] for _ in range(worlds)]
    kinds = np.full(worlds, int(kind), dtype=np.int64)
    previous = blank(history.row(0))
    for t in range(1, steps):
        current = history.row(t)
        for w, names in enumerate(event_names(kinds, step_events(kinds, previous, current))):
            extend(events[w], kind, names)
        previous = current
    success = history.success[1:].any(axis=0)
    return [
        legacy_label(kind, events[w], bool(success[w]), bool(history.at_goal[1, w]))
        for w in range(worlds)
    ]
