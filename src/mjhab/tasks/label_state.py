"""State from which labels and events are computed: the steps of a subtask, folded one by one into a `LabelState`.

Recorded histories go through the same fold (`fold`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from mjhab.core.arrays import Array, as_like, map_record, namespace, pile, to_numpy
from mjhab.core.errors import unknown_name


class Watched(Protocol):
    """Signals that labels and events read, (W,) bool each; `Signals` and rows of a `History` have them."""

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
            **{
                name: xp.stack([getattr(row, name) for row in rows], axis=0)
                for name in names
            }
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
"""Falling edges of the first two rows: the object was released, the object left its goal."""
_NOW = {name: row for row, name in enumerate(WATCHED)}
_EVER = {name: row for row, name in enumerate((*WATCHED, *_FALLS))}


def watch(signals: Watched) -> Array:
    """Stack the signals that labels and events read in one step: (K, W) bool with the rows ``WATCHED``."""
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
            # Turned round, so that every row is False while nothing has happened.
            ~s.force_ok,
        )
    )


@dataclass(frozen=True)
class LabelState:
    """Summary of the steps of a subtask so far, from which its label follows. All arrays are bool."""

    now: Array
    """(K, W) the last step, rows ``WATCHED``."""
    seen: Array
    """(K + 2, W) rows ``WATCHED``: the check has held in some step, the start state included; then whether the object
    was released, and whether it left its goal, at least once."""
    must_hold: Array
    """(W,) the signal at the start of the subtask."""
    release_at_goal: Array
    """(W,) at the last release the object was at its goal; before any release: at the start it was."""
    first_success_release: Array
    """(W,) ``release_at_goal`` at the first success."""

    def holds(self, name: str) -> Array:
        """(W,) bool: the check of ``WATCHED`` holds in the last step.

        Raises:
            UsageError: there is no such signal.
        """
        return self.now[_row(name, _NOW)]

    def ever(self, name: str) -> Array:
        """(W,) bool: the check of ``WATCHED`` has held, or the object was "released" or has "left_goal".

        Raises:
            UsageError: there is no such signal.
        """
        return self.seen[_row(name, _EVER)]


def _row(name: str, rows: Mapping[str, int]) -> int:
    try:
        return rows[name]
    except (KeyError, TypeError):
        raise unknown_name("signal", str(name), rows) from None


def uneventful(num_worlds: int) -> LabelState:
    """State of W worlds, as numpy arrays, in which every check is and was False."""
    no = np.zeros(num_worlds, bool)
    return LabelState(
        np.zeros((len(_NOW), num_worlds), bool),
        np.zeros((len(_EVER), num_worlds), bool),
        no,
        no,
        no,
    )


def start(signals: Watched) -> LabelState:
    """Begin with the state at the start of the subtask (t = 0)."""
    now = watch(signals)
    # False rows made of what is there, which works for any library and device.
    no = now[: len(_FALLS)] & ~now[: len(_FALLS)]
    at_goal = now[_NOW["at_goal"]]
    return LabelState(
        now, namespace(now).concat((now, no)), signals.must_hold, at_goal, at_goal
    )


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
        # Falls are kept apart, since a row that is True again hides that it was False in between.
        state.seen | xp.concat((now, falls)),
        state.must_hold,
        release_at_goal,
        # Frozen from the first success on: a later release must not change how it was reached.
        xp.where(state.ever("success"), state.first_success_release, release_at_goal),
    )


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


def get_row(state: LabelState, w: int) -> dict[str, Any]:
    """Copy of what a label state says about world ``w``, as numpy arrays."""
    return {
        f.name: to_numpy(getattr(state, f.name)[..., w]).copy()
        for f in dataclasses.fields(state)
    }


def _with_ee_contact(rows: Any) -> np.ndarray:
    """Rows ``WATCHED`` (and ``_FALLS``) of one world, (K,) or (K + 2,); ``touch`` stands in for a lacking row."""
    values = np.asarray(rows)
    lacking = len(values) in (len(WATCHED) - 1, len(WATCHED) - 1 + len(_FALLS))
    return (
        np.insert(values, _NOW["ee_contact"], values[_NOW["touch"]])
        if lacking
        else values
    )


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
