"""How a subtask went: exactly one label per subtask, from boolean signals.

The published labels (MS-HAB paper App. A.6) are counts over event lists, which overlap and leave gaps. Here each kind
has a decision list over signals of the steps t = 0 (the state at the start) to T: the first rule that holds gives
the label, and the last rule of each branch always holds, so every history has exactly one label.

The signals are folded step by step into a small ``LabelState``; a recorded history goes through the same fold.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from mjhab.core.arrays import Array, map_record, namespace, to_numpy, where_rows
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
        return History(**{name: xp.stack([getattr(row, name) for row in rows], axis=0) for name in names})


@dataclass(frozen=True)
class LabelState:
    """What a label needs of the steps seen so far. (W,) bool; ``ever_*`` include the start state."""

    success: Array
    """Some step was a success."""
    excess: Array
    """Some step had accumulated too much force."""
    must_hold: Array
    grasped: Array
    """Now, like the next three."""
    at_goal: Array
    opened: Array
    closed: Array
    ever_grasped: Array
    ever_touched: Array
    ever_at_goal: Array
    ever_opened: Array
    ever_closed: Array
    ever_slightly_opened: Array
    ever_slightly_closed: Array
    released: Array
    """The object was let go at least once."""
    left_goal: Array
    """The object left its goal at least once."""
    release_at_goal: Array
    """At the last release the object was at its goal; before any release: it started there."""
    first_success_release: Array
    """``release_at_goal`` as it was at the first success."""


def start(signals: Watched) -> LabelState:
    """Begin with the state at the start of the subtask (t = 0)."""
    s = signals
    no = s.success & ~s.success
    return LabelState(
        success=s.success,
        excess=~s.force_ok,
        must_hold=s.must_hold,
        grasped=s.is_grasped,
        at_goal=s.at_goal,
        opened=s.opened,
        closed=s.closed,
        ever_grasped=s.is_grasped,
        ever_touched=s.touch,
        ever_at_goal=s.at_goal,
        ever_opened=s.opened,
        ever_closed=s.closed,
        ever_slightly_opened=s.slightly_opened,
        ever_slightly_closed=s.slightly_closed,
        released=no,
        left_goal=no,
        release_at_goal=s.at_goal,
        first_success_release=s.at_goal,
    )


def restart(state: LabelState, mask: Array, signals: Watched) -> LabelState:
    """Begin anew for the worlds in ``mask`` (W,), whose next subtask starts with ``signals``."""
    return where_rows(mask, start(signals), state)


def update(state: LabelState, signals: Watched) -> LabelState:
    """Add one step."""
    s = signals
    release = state.grasped & ~s.is_grasped
    release_at_goal = (release & s.at_goal) | (~release & state.release_at_goal)
    first = (state.success & state.first_success_release) | (~state.success & release_at_goal)
    return LabelState(
        success=state.success | s.success,
        excess=state.excess | ~s.force_ok,
        must_hold=state.must_hold,
        grasped=s.is_grasped,
        at_goal=s.at_goal,
        opened=s.opened,
        closed=s.closed,
        ever_grasped=state.ever_grasped | s.is_grasped,
        ever_touched=state.ever_touched | s.touch,
        ever_at_goal=state.ever_at_goal | s.at_goal,
        ever_opened=state.ever_opened | s.opened,
        ever_closed=state.ever_closed | s.closed,
        ever_slightly_opened=state.ever_slightly_opened | s.slightly_opened,
        ever_slightly_closed=state.ever_slightly_closed | s.slightly_closed,
        released=state.released | release,
        left_goal=state.left_goal | (state.at_goal & ~s.at_goal),
        release_at_goal=release_at_goal,
        first_success_release=first,
    )


def _pick_rules(s: LabelState) -> list[Array]:
    return [
        s.success & s.excess,
        s.success & ~s.grasped,
        s.success & s.released,
        s.success,
        s.excess,
        ~s.ever_grasped & ~s.ever_touched,
        ~s.ever_grasped,
        ~s.grasped,
    ]


def _place_rules(s: LabelState) -> list[Array]:
    return [
        s.success & s.excess,
        s.success & ~s.at_goal,
        s.success & s.left_goal,
        s.success & ~s.first_success_release,
        s.success,
        s.excess,
        ~s.ever_grasped,
        ~s.ever_at_goal,
        s.grasped,
        s.at_goal,
        s.release_at_goal,
    ]


def _navigate_rules(s: LabelState) -> list[Array]:
    lost = s.must_hold & ~s.grasped
    return [s.success & s.excess, s.success & lost, s.success, s.excess, lost]


def _joint_rules(s: LabelState, there: Array, ever_there: Array, ever_slightly: Array) -> list[Array]:
    return [
        s.success & s.excess,
        s.success & ~there,
        s.success,
        s.excess,
        ~s.ever_touched,
        ever_there & ~there,
        ever_there,
        ever_slightly,
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
        return _joint_rules(s, s.opened, s.ever_opened, s.ever_slightly_opened)
    return _joint_rules(s, s.closed, s.ever_closed, s.ever_slightly_closed)


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
        state = new if valid is None else where_rows(valid[t], new, state)
    return state


def label_history(kind: Array, history: History, valid: Array | None = None) -> Array:
    """Label a recorded history: (W,) int64 codes, the same as those of the running state."""
    return label(fold(history, valid), kind)
