"""Conditions of success, and the checks that apply to each kind of subtask, as tables over the kinds.

``force_ok`` means that the force accumulated over the subtask is within its limit; a subtask with too much force cannot
succeed.
"""

from __future__ import annotations

from functools import lru_cache

from mjhab.core.arrays import Array, Table, constant, pile
from mjhab.tasks.signals import CHECKS, Signals
from mjhab.tasks.subtasks.registry import SUBTASKS, check_kinds
from mjhab.tasks.subtasks.spec import COMMON_CHECKS

FORCE_CHECK = "force_ok"
_NEVER_TRUE = "at_goal"
"""Condition of a finished plan, for which this check is always False: a finished plan does not succeed again."""


@lru_cache(maxsize=8)
def _applies(version: int) -> Table:
    """(C, K + 1): the check means something for the kind; the last column is for kind -1, a finished plan."""
    specs = SUBTASKS.values()
    return Table(
        tuple(
            (*(s.applies(name) for s in specs), name in COMMON_CHECKS) for name in CHECKS
        )
    )


@lru_cache(maxsize=16)
def _optional(version: int, ignore_arm: bool) -> Table:
    """(C, K + 1): the check is no condition of the kind."""
    needs = (*(spec.needs(ignore_arm) for spec in SUBTASKS.values()), (_NEVER_TRUE,))
    return Table(tuple(tuple(name not in column for column in needs) for name in CHECKS))


def masks(kind: Array, ignore_arm: bool) -> tuple[Array, Array]:
    """Look up which checks apply to the active kinds and which are optional for success.

    Args:
        kind: (W,) int64, -1 for a finished plan, which never succeeds.
        ignore_arm: kinds drop their ``arm_conditions`` (Navigate, where it is teleported).

    Returns:
        applies, optional: (K, W) bool, rows ``CHECKS``. The valid checks are ``checks & applies``; a subtask succeeds
        where all of ``checks | optional`` hold.
    """
    check_kinds(kind)
    no = kind < kind
    applies = constant(_applies(SUBTASKS.version), no)
    optional = constant(_optional(SUBTASKS.version, ignore_arm), no)
    return applies[:, kind], optional[:, kind]


def succeeds_whatever_force(signals: Signals) -> Array:
    """(W,) bool: all conditions of success of the active subtask hold, but for the limit on the accumulated force.

    Evaluations that go on after this limit was exceeded and look at the other conditions count it as a success.
    """
    # They are no fields of `Signals`.
    held = holding_checks(signals.is_grasped, signals.must_hold)
    rows = [held[name] if name in held else getattr(signals, name) for name in CHECKS]
    _, optional = masks(signals.kind, ignore_arm=False)
    others = [row for row, name in enumerate(CHECKS) if name != FORCE_CHECK]
    return (pile(rows) | optional)[others].all(0)


def holding_checks(is_grasped: Array, must_hold: Array) -> dict[str, Array]:
    """The checks (W,) of CHECKS about what is held, by name."""
    return {"let_go": ~is_grasped, "hold_ok": is_grasped | ~must_hold}
