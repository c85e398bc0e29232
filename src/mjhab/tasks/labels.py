"""How a subtask went: exactly one label per subtask, from boolean signals.

The published labels (MS-HAB paper App. A.6) are counts over event lists, which overlap and leave gaps. Here each kind
has a decision list over signals of the steps t = 0 (the state at the start) to T: the first rule that holds gives
the label, and the last rule of each branch always holds, so every history has exactly one label.

"Reached" and "touched" in a label speak of the end effector, fingers and hand, as ``F_ee,a`` of the paper does:
an elbow that pushes a door has not reached its handle.

The signals are folded step by step into a small ``LabelState``; a recorded history goes through the same fold.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from mjhab.core.arrays import Array, as_like, map_record, namespace, pile, to_numpy
from mjhab.tasks.plan import SubtaskKind

LABELS: dict[SubtaskKind, tuple[str, ...]] = {
    SubtaskKind.PICK: (
        "success_then_excessive_collisions",
        "success_then_drop",
        "winding_success",
        "straightforward_success",
        "excessive_collision_failure",
        "mobility_failure",
        "cant_grasp_failure",
        "drop_failure",
        "too_slow_failure",
    ),
    SubtaskKind.PLACE: (
        "success_then_excessive_collisions",
        "dubious_success",
        "winding_success",
        "dropped_to_goal_success",
        "placed_in_goal_success",
        "excessive_collision_failure",
        "didnt_grasp_failure",
        "didnt_reach_goal_failure",
        "wont_let_go_failure",
        "too_slow_failure",
        "place_in_goal_failure",
        "drop_to_goal_failure",
    ),
    SubtaskKind.NAVIGATE: (
        "success_then_excessive_collisions",
        "success_then_dropped",
        "navigation_success",
        "excessive_collision_failure",
        "dropped_failure",
        "navigation_failure",
    ),
    SubtaskKind.OPEN: (
        "success_then_excessive_collisions",
        "dubious_success",
        "open_success",
        "excessive_collision_failure",
        "cant_reach_articulation_failure",
        "closed_after_open_failure",
        "too_slow_failure",
        "slightly_open_failure",
        "cant_open_failure",
    ),
    SubtaskKind.CLOSE: (
        "success_then_excessive_collisions",
        "dubious_success",
        "closed_success",
        "excessive_collision_failure",
        "cant_reach_articulation_failure",
        "open_after_closing_failure",
        "too_slow_failure",
        "slightly_closed_failure",
        "cant_close_failure",
    ),
}
"""Labels of every kind in the order of their rules; a label's code is its index."""


class Watched(Protocol):
    """What labels and events look at: ``Signals`` has all of it, and so has one row of a ``History``."""

    @property
    def is_grasped(self) -> Array: ...
    @property
    def at_goal(self) -> Array: ...
    @property
    def opened(self) -> Array: ...
    @property
    def closed(self) -> Array: ...
    @property
    def slightly_opened(self) -> Array: ...
    @property
    def slightly_closed(self) -> Array: ...
    @property
    def near(self) -> Array: ...
    @property
    def contact(self) -> Array: ...
    @property
    def touch(self) -> Array: ...
    @property
    def ee_contact(self) -> Array: ...
    @property
    def force_ok(self) -> Array: ...
    @property
    def success(self) -> Array: ...
    @property
    def must_hold(self) -> Array: ...


@dataclass(frozen=True)
class History:
    """Recorded signals, each (T+1, W) bool, or (W,) for one row; named as in ``Signals``. Row 0 is the start state."""

    is_grasped: Array
    at_goal: Array
    opened: Array
    closed: Array
    slightly_opened: Array
    slightly_closed: Array
    near: Array
    contact: Array
    touch: Array
    ee_contact: Array
    force_ok: Array
    success: Array
    must_hold: Array

    def row(self, t: int) -> History:
        """Return step ``t`` of all worlds."""
        return map_record(lambda x: x[t], self)

    @staticmethod
    def stack(rows: Sequence[Watched]) -> History:
        """Return the history of T+1 steps of signals."""
        xp = namespace(rows[0].success)
        names = [f.name for f in dataclasses.fields(History)]
        return History(
            **{name: xp.stack([getattr(row, name) for row in rows], axis=0) for name in names}
        )


WATCHED: tuple[str, ...] = (
    "is_grasped",
    "at_goal",
    "opened",
    "closed",
    "slightly_opened",
    "slightly_closed",
    "near",
    "contact",
    "touch",
    "ee_contact",
    "success",
    "excess",
)
"""Rows of a watched step, named as in ``Signals``; ``excess``: more force than allowed has been accumulated."""
_FALLS = ("released", "left_goal")
"""The object was let go, the object left its goal: the first two rows stopped to hold."""
_NOW = {name: row for row, name in enumerate(WATCHED)}
_EVER = {name: row for row, name in enumerate((*WATCHED, *_FALLS))}


def watch(signals: Watched) -> Array:
    """Return what labels and events look at in one step as (K, W) bool, rows ``WATCHED``."""
    s = signals
    return pile(
        (
            s.is_grasped,
            s.at_goal,
            s.opened,
            s.closed,
            s.slightly_opened,
            s.slightly_closed,
            s.near,
            s.contact,
            s.touch,
            s.ee_contact,
            s.success,
            ~s.force_ok,
        )
    )


@dataclass(frozen=True)
class LabelState:
    """What a label needs of the steps seen so far. Bool."""

    now: Array
    """(K, W) the last step, rows ``WATCHED``."""
    seen: Array
    """(K + 2, W) what held in some step, the start state included; then whether the object was let go and whether it
    left its goal at least once."""
    must_hold: Array
    """(W,) at the start, like the next two."""
    release_at_goal: Array
    """At the last release the object was at its goal; before any release: it started there."""
    first_success_release: Array
    """``release_at_goal`` as it was at the first success."""

    def holds(self, name: str) -> Array:
        """(W,) bool: the check of ``WATCHED`` holds in the last step."""
        return self.now[_NOW[name]]

    def ever(self, name: str) -> Array:
        """(W,) bool: the check of ``WATCHED`` has held, or the object was "released" or has "left_goal"."""
        return self.seen[_EVER[name]]


def start(signals: Watched) -> LabelState:
    """Begin with the state at the start of the subtask (t = 0)."""
    now = watch(signals)
    no = now[: len(_FALLS)] & ~now[: len(_FALLS)]
    at_goal = now[_NOW["at_goal"]]
    return LabelState(now, namespace(now).concat((now, no)), signals.must_hold, at_goal, at_goal)


def choose(mask: Array, new: LabelState, old: LabelState) -> LabelState:
    """The worlds of ``mask`` (W,) bool from ``new``, the others from ``old``."""
    where = namespace(mask).where
    return LabelState(
        where(mask, new.now, old.now),
        where(mask, new.seen, old.seen),
        where(mask, new.must_hold, old.must_hold),
        where(mask, new.release_at_goal, old.release_at_goal),
        where(mask, new.first_success_release, old.first_success_release),
    )


def restart(state: LabelState, mask: Array, signals: Watched) -> LabelState:
    """Begin anew for the worlds in ``mask`` (W,), whose next subtask starts with ``signals``."""
    return choose(mask, start(signals), state)


def update(state: LabelState, signals: Watched) -> LabelState:
    """Add one step."""
    return add(state, watch(signals))


def add(state: LabelState, now: Array) -> LabelState:
    """Add one step that has been watched: (K, W) bool, rows ``WATCHED``."""
    xp = namespace(now)
    falls = state.now[: len(_FALLS)] & ~now[: len(_FALLS)]
    release_at_goal = xp.where(falls[0], now[_NOW["at_goal"]], state.release_at_goal)
    return LabelState(
        now,
        state.seen | xp.concat((now, falls)),
        state.must_hold,
        release_at_goal,
        xp.where(state.ever("success"), state.first_success_release, release_at_goal),
    )


def _pick_rules(s: LabelState) -> list[Array]:
    return [
        s.ever("success") & s.ever("excess"),
        s.ever("success") & ~s.holds("is_grasped"),
        s.ever("success") & s.ever("released"),
        s.ever("success"),
        s.ever("excess"),
        ~s.ever("is_grasped") & ~s.ever("ee_contact"),
        ~s.ever("is_grasped"),
        ~s.holds("is_grasped"),
    ]


def _place_rules(s: LabelState) -> list[Array]:
    return [
        s.ever("success") & s.ever("excess"),
        s.ever("success") & ~s.holds("at_goal"),
        s.ever("success") & s.ever("left_goal"),
        s.ever("success") & ~s.first_success_release,
        s.ever("success"),
        s.ever("excess"),
        ~s.ever("is_grasped"),
        ~s.ever("at_goal"),
        s.holds("is_grasped"),
        s.holds("at_goal"),
        s.release_at_goal,
    ]


def _navigate_rules(s: LabelState) -> list[Array]:
    lost = s.must_hold & ~s.holds("is_grasped")
    return [
        s.ever("success") & s.ever("excess"),
        s.ever("success") & lost,
        s.ever("success"),
        s.ever("excess"),
        lost,
    ]


def _joint_rules(s: LabelState, there: str, slightly: str) -> list[Array]:
    return [
        s.ever("success") & s.ever("excess"),
        s.ever("success") & ~s.holds(there),
        s.ever("success"),
        s.ever("excess"),
        ~s.ever("ee_contact"),
        s.ever(there) & ~s.holds(there),
        s.ever(there),
        s.ever(slightly),
    ]


def _rules(state: LabelState, kind: SubtaskKind) -> list[Array]:
    """Conditions (W,) bool of all labels of a kind but the last, in order; the first that holds decides.

    The success branch ends with the bare condition ``success``: every later rule may assume failure.
    """
    s = state
    if kind == SubtaskKind.PICK:
        return _pick_rules(s)
    if kind == SubtaskKind.PLACE:
        return _place_rules(s)
    if kind == SubtaskKind.NAVIGATE:
        return _navigate_rules(s)
    if kind == SubtaskKind.OPEN:
        return _joint_rules(s, "opened", "slightly_opened")
    return _joint_rules(s, "closed", "slightly_closed")


def label(state: LabelState, kind: Array) -> Array:
    """Return the label of every world as (W,) int64 codes: index into ``LABELS`` of its kind.

    Args:
        state: the steps seen so far.
        kind: (W,) int64 kinds of the subtasks; -1 gives code -1.
    """
    xp = namespace(kind)
    codes = xp.zeros_like(kind) - 1
    for each in SubtaskKind:
        code = xp.zeros_like(kind) + (len(LABELS[each]) - 1)
        rules = _rules(state, each)
        for value in range(len(rules) - 1, -1, -1):
            code = xp.where(rules[value], value, code)
        codes = xp.where(kind == int(each), code, codes)
    return codes


def label_names(kind: Array, codes: Array) -> list[str]:
    """Return the labels behind the codes (W,), an empty string for -1."""
    pairs = zip(to_numpy(kind).tolist(), to_numpy(codes).tolist(), strict=True)
    return ["" if code < 0 else LABELS[SubtaskKind(k)][code] for k, code in pairs]


def fold(history: History, valid: Array | None = None) -> LabelState:
    """Run the signals of a recorded history through ``start`` and ``update``.

    Args:
        history: (T+1, W) signals of one subtask per world.
        valid: (T+1, W) bool, False after the end of a world's subtask; all steps count if not given.
    """
    state = start(history.row(0))
    for t in range(1, history.success.shape[0]):
        new = update(state, history.row(t))
        state = new if valid is None else choose(valid[t], new, state)
    return state


def label_history(kind: Array, history: History, valid: Array | None = None) -> Array:
    """Label a recorded history: (W,) int64 codes, the same as those of the running state."""
    return label(fold(history, valid), kind)


def get_row(state: LabelState, w: int) -> dict[str, Any]:
    """Copy of what a label state says about world ``w``, as numpy arrays."""
    return {
        f.name: to_numpy(getattr(state, f.name)[..., w]).copy() for f in dataclasses.fields(state)
    }


def _with_ee_contact(rows: Any) -> np.ndarray:
    """Rows ``WATCHED`` (and ``_FALLS``) of one world, (K,) or (K + 2,); ``touch`` stands in for a lacking row."""
    values = np.asarray(rows)
    lacking = len(values) in (len(WATCHED) - 1, len(WATCHED) - 1 + len(_FALLS))
    return np.insert(values, _NOW["ee_contact"], values[_NOW["touch"]]) if lacking else values


def set_row(state: LabelState, w: int, row: Mapping[str, Any]) -> LabelState:
    """A copy of a label state in which world ``w`` is as ``get_row`` gave it.

    In rows of versions that had no ``ee_contact`` it is what ``touch`` is.
    """

    def put(name: str) -> Array:
        array = namespace(state.now).asarray(getattr(state, name), copy=True)
        array[..., w] = as_like(
            _with_ee_contact(row[name]) if name in ("now", "seen") else row[name], array
        )
        return array

    return LabelState(*(put(f.name) for f in dataclasses.fields(state)))
