"""When a subtask is done: the conditions of every kind, and which signals mean anything for it, as tables.

Conditions of the MS-HAB paper (App. A.2) and mshab/envs/sequential_task.py. ``force_ok`` means that the force
accumulated over the subtask is within its limit; a subtask with too much force cannot succeed.
"""

from __future__ import annotations

from mjhab.core.arrays import Array, Table, constant
from mjhab.tasks.plan import SubtaskKind

CHECKS: tuple[str, ...] = (
    "is_grasped",
    "ee_rest",
    "robot_rest",
    "is_static",
    "force_ok",
    "contact",
    "touch",
    "ee_contact",
    "at_goal",
    "opened",
    "closed",
    "slightly_opened",
    "slightly_closed",
    "near",
    "oriented",
    "let_go",
    "hold_ok",
)
"""Rows of the check tables. ``let_go``: nothing is held; ``hold_ok``: the object to carry is held, or there is none."""

_AT_REST = ("ee_rest", "robot_rest", "is_static", "force_ok")
CONDITIONS: dict[SubtaskKind, tuple[str, ...]] = {
    SubtaskKind.PICK: ("is_grasped", *_AT_REST),
    SubtaskKind.PLACE: ("let_go", "at_goal", *_AT_REST),
    SubtaskKind.NAVIGATE: ("near", "oriented", "hold_ok", *_AT_REST),
    SubtaskKind.OPEN: ("opened", *_AT_REST),
    SubtaskKind.CLOSE: ("closed", *_AT_REST),
}
"""Checks that must hold together for a subtask to be done."""
ARM_CONDITIONS = ("hold_ok", "ee_rest", "robot_rest")
"""Conditions on arm and grasp; Navigate drops them when it ignores the arm (used with teleport navigation)."""

_JOINTED = (SubtaskKind.OPEN, SubtaskKind.CLOSE)
ONLY_FOR: dict[str, tuple[SubtaskKind, ...]] = {
    "at_goal": (SubtaskKind.PLACE,),
    "opened": _JOINTED,
    "closed": _JOINTED,
    "slightly_opened": _JOINTED,
    "slightly_closed": _JOINTED,
    "near": (SubtaskKind.NAVIGATE,),
    "oriented": (SubtaskKind.NAVIGATE,),
}
"""Checks that are False for every other kind, and once the plan is finished."""

# One column per kind; the last is for kind -1 (finished), which an index of -1 reads. It asks for a check that is
# never true there, so that a finished plan does not succeed again.
_APPLIES = Table(
    tuple(
        tuple(name not in ONLY_FOR or kind in ONLY_FOR[name] for kind in (*SubtaskKind, None))
        for name in CHECKS
    )
)


def _optional(ignore_arm: bool) -> Table:
    """(K, 6): the check is no condition of the kind."""
    needs = dict(CONDITIONS)
    if ignore_arm:
        needs[SubtaskKind.NAVIGATE] = tuple(
            n for n in needs[SubtaskKind.NAVIGATE] if n not in ARM_CONDITIONS
        )
    columns = (*(needs[kind] for kind in SubtaskKind), ("at_goal",))
    return Table(tuple(tuple(name not in column for column in columns) for name in CHECKS))


_OPTIONAL = {ignore_arm: _optional(ignore_arm) for ignore_arm in (False, True)}


def masks(kind: Array, ignore_arm: bool) -> tuple[Array, Array]:
    """Return what the active kinds make of the checks.

    Args:
        kind: (W,) int64, -1 for a finished plan, which never succeeds.
        ignore_arm: Navigate drops ``ARM_CONDITIONS``.

    Returns:
        applies, optional: (K, W) bool, rows ``CHECKS``. Checks count as ``checks & applies``; the subtask is done
        where all of ``checks | optional`` hold.
    """
    no = kind < kind
    return constant(_APPLIES, no)[:, kind], constant(_OPTIONAL[ignore_arm], no)[:, kind]
