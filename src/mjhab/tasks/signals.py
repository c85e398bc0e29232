"""Records of arrays: the state of the worlds after a control step, and the signals that `measure` computes from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from mjhab.core.arrays import Array

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
SIGNAL_CHECKS = CHECKS[: CHECKS.index("let_go")]
"""Checks that are fields of `Signals`; the others are only conditions of success."""
JOINT_CHECKS = ("opened", "closed", "slightly_opened", "slightly_closed")
"""Checks of the joint of a subtask's link."""
WAY_CHECKS = ("near", "oriented")
"""Checks of the base on its way to a goal."""


class MeasuredProgress(Protocol):
    """Fields of `progress.Progress` that `measure` reads."""

    @property
    def pointer(self) -> Array:
        """(W,) int64 position of the active subtask."""
        ...

    @property
    def cumulative_force(self) -> Array:
        """(W,) [N x control steps] over the active subtask."""
        ...


@dataclass(frozen=True)
class WorldState:
    """State of W worlds after a control step, float unless said; world frame, SI units."""

    base_pose: Array
    """(W, 3) x, y [m] and yaw [rad] of the base."""
    robot_q: Array
    """(W, J) joint positions: base, posture, fingers."""
    robot_qd: Array
    """(W, J) joint velocities."""
    tcp_pos: Array
    """(W, 3) position of the tcp, between the fingers."""
    finger_force: Array
    """(W, 2, 3) force [N] by the active target (object or handle link) on the [l, r] finger."""
    finger_dir: Array
    """(W, 2, 3) unit directions in which the [l, r] finger opens."""
    robot_force: Array
    """(W,) contact force [N] summed over robot links without the fingers."""
    fingers_force: Array
    """(W,) contact force [N] summed over the two fingers, by whatever they touch; no limit counts it."""
    target_contact: Array
    """(W,) bool: any robot link touches the active target."""
    ee_contact: Array
    """(W,) bool: the end effector (fingers or hand) touches the active target."""
    plan_obj_pos: Array
    """(W, S, 3) position of the object of every subtask of the plan, zeros if it has none."""
    joint_q: Array
    """(W,) joint position of the active subtask's link [m or rad], zero without one; likewise the next three."""
    joint_min: Array
    joint_max: Array
    joint_start: Array
    """(W,) joint position at the start of the subtask."""
    held_force: Array
    """(W, 2, 3) like ``finger_force``, by the object that Navigate must carry; zeros if none."""


@dataclass(frozen=True)
class Signals:
    """Signals of the active subtask of every world. (W,) bool unless said; False where a signal does not apply."""

    is_grasped: Array
    """Both fingers press the target (Navigate: the carried object) with >= 0.5 N within 30 degrees."""
    at_goal: Array
    """Place: the object is at its goal."""
    ee_rest: Array
    robot_rest: Array
    is_static: Array
    force_ok: Array
    opened: Array
    closed: Array
    slightly_opened: Array
    """Open, Close: the joint is at least 10 % of its range open."""
    slightly_closed: Array
    """Open, Close: the joint has moved at least 5 % of its range from its start towards closed."""
    near: Array
    """Navigate: within the distance, and inside the area in front of the furniture where the plan has one."""
    oriented: Array
    """Navigate: the goal is within 0.5 rad of the heading."""
    contact: Array
    """A finger presses the target."""
    touch: Array
    """Any robot link touches the target."""
    ee_contact: Array
    """The end effector (fingers or hand) touches the target: ``F_ee,a`` of MS-HAB paper App. A.6."""
    robot_force: Array
    """(W,) [N]."""
    target_force: Array
    """(W,) sum of the magnitudes of the two finger forces [N]."""
    cumulative_force: Array
    """(W,) [N x control steps] over the active subtask."""
    success: Array
    """The active subtask is achieved now."""
    placed_ok: Array
    """Every object of an already finished Place is still at its goal."""
    kind: Array
    """(W,) int64 kind of the active subtask, -1 once the plan is finished."""
    must_hold: Array
    """Navigate: an object is carried."""


@dataclass(frozen=True)
class Active:
    """Entries of the plan for the active subtask of every world; for the last one once the plan is finished.

    They depend on plan and pointer alone, so that they can be reused until a pointer moves.
    """

    index: Array
    """(W,) int64 position in the plan."""
    kind: Array
    """(W,) int64, -1 once the plan is finished."""
    goal_pos: Array
    """(W, 3), like the next two as in ``PlanArrays``."""
    open_frac: Array
    box: Array
    navigate: Array
    """(W,) bool."""
    must_hold: Array
    """(W,) bool: a Navigate that carries an object."""
    rest_tol: Array
    """(W, P) largest distance of torso, head and arm from rest [m or rad]; larger with an object in the hand."""
    force_limit: Array
    """(W,) [N x control steps], infinite once the plan is finished."""
    unfinished: Array
    """(W, S) bool: anything but a completed subtask whose object must stay at its goal."""
    applies: Array
    """(K, W) bool, rows ``CHECKS``: the check means something for the kind; see ``success.masks``."""
    optional: Array
    """(K, W) bool: the check is no condition of the kind."""
    has_goals: bool
    """The object of some world's subtask, or of a finished one, has to be at a goal. On a device, which is not asked,
    this and the next two are True."""
    has_joints: bool
    """Some world's subtask has a check of ``JOINT_CHECKS``."""
    has_ways: bool
    """Some world's subtask has a check of ``WAY_CHECKS``."""
