"""When a subtask is done, and which checks mean anything for it: tables over the kinds of subtasks.

``force_ok`` means that the force accumulated over the subtask is within its limit; a subtask with too much force cannot
succeed.
"""

from __future__ import annotations

from functools import lru_cache

from mjhab.core.arrays import Array, Table, constant
from mjhab.tasks.signals import CHECKS
from mjhab.tasks.subtasks.registry import SUBTASKS, check_kinds
from mjhab.tasks.subtasks.spec import COMMON_CHECKS

_NEVER_TRUE = "at_goal"
"""What a finished plan is asked for, so that it does not succeed again: there the check is always False."""


@lru_cache(maxsize=8)
def _applies(version: int) -> Table:
    """(C, K + 1): the check means something for the kind; the last column is for kind -1, a finished plan."""
    specs = SUBTASKS.values()
    return Table(
        tuple((*(s.applies(name) for s in specs), name in COMMON_CHECKS) for name in CHECKS)
    )


@lru_cache(maxsize=16)
def _optional(version: int, ignore_arm: bool) -> Table:
    """(C, K + 1): the check is no condition of the kind."""
    needs = (*(spec.needs(ignore_arm) for spec in SUBTASKS.values()), (_NEVER_TRUE,))
    return Table(tuple(tuple(name not in column for column in needs) for name in CHECKS))


def masks(kind: Array, ignore_arm: bool) -> tuple[Array, Array]:
    """Return what the active kinds make of the checks.

    Args:
        kind: (W,) int64, -1 for a finished plan, which never succeeds.
        ignore_arm: kinds drop their ``arm_conditions`` (Navigate, where it is teleported).

    Returns:
        applies, optional: (K, W) bool, rows ``CHECKS``. Checks count as ``checks & applies``; the subtask is done
        where all of ``checks | optional`` hold.
    """
    check_kinds(kind)
    no = kind < kind
    applies = constant(_applies(SUBTASKS.version), no)
    optional = constant(_optional(SUBTASKS.version, ignore_arm), no)
    return applies[:, kind], optional[:, kind]
