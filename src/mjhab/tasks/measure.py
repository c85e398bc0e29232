"""Measure the active subtask of every world: plain physical quantities in, boolean and float signals out.

Distances are Euclidean, speeds absolute, every threshold counts as reached at equality (MS-HAB paper App. A.2).
Nothing is mutated; the same lines run on numpy and torch, and keep the dtype of the state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from mjhab.core.arrays import Array, constant, device_of, dot3, namespace, norm3, pick_column
from mjhab.core.errors import UsageError
from mjhab.tasks import success as done
from mjhab.tasks.plan import PADDING, PlanArrays, SubtaskKind, TaskConfig

if TYPE_CHECKING:
    from mjhab.tasks.progress import Progress

__all__ = ["PlanArrays", "Signals", "WorldState", "measure"]


@dataclass(frozen=True)
class WorldState:
    """What the simulator knows about W worlds after a control step. Floats unless said; world frame, SI units."""

    base_pose: Array
    """(W, 3) x, y [m] and yaw [rad] of the base."""
    robot_q: Array
    """(W, 15) joint positions in the order of ``FETCH_JOINTS``."""
    robot_qd: Array
    """(W, 15) joint velocities."""
    tcp_pos: Array
    """(W, 3) tool centre between the fingers."""
    finger_force: Array
    """(W, 2, 3) force [N] by the active target (object or handle link) on the [l, r] finger."""
    finger_dir: Array
    """(W, 2, 3) unit directions in which the [l, r] finger opens."""
    robot_force: Array
    """(W,) contact force [N] summed over robot links without the fingers."""
    target_contact: Array
    """(W,) bool: any robot link touches the active target."""
    plan_obj_pos: Array
    """(W, S, 3) position of the object of every subtask of the plan, zeros if it has none."""
    joint_q: Array
    """(W,) joint of the active subtask's link, zero if it has none; likewise the next three."""
    joint_min: Array
    joint_max: Array
    joint_start: Array
    """(W,) the joint at the start of the subtask."""
    held_force: Array
    """(W, 2, 3) like ``finger_force``, by the object that Navigate must carry; zeros if none."""


@dataclass(frozen=True)
class Signals:
    """What holds for the active subtask of every world. (W,) bool unless said; False where it does not apply."""

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
    robot_force: Array
    """(W,) [N]."""
    target_force: Array
    """(W,) [N], sum of the lengths of the two finger forces."""
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
class _Active:
    """Entries of the plan for the active subtask of every world."""

    kind: Array
    goal_pos: Array
    obj_pos: Array
    must_hold: Array
    open_frac: Array
    box: Array
    goal_rect: Array | None


def _active(state: WorldState, plan: PlanArrays, pointer: Array) -> _Active:
    """Gather the entries of the active subtask of every world; kind -1 where the plan is finished."""
    xp = namespace(pointer)
    index = xp.minimum(pointer, plan.length - 1)
    kind = xp.where(pointer < plan.length, pick_column(plan.kind, index), PADDING)
    return _Active(
        kind,
        pick_column(plan.goal_pos, index),
        pick_column(state.plan_obj_pos, index),
        pick_column(plan.must_hold, index),
        pick_column(plan.open_frac, index),
        pick_column(plan.box, index),
        None if plan.goal_rect is None else pick_column(plan.goal_rect, index),
    )


def _grasped(force: Array, norm: Array, opening: Array, config: TaskConfig) -> Array:
    """Whether both fingers are pushed open hard enough and straight enough. Returns (W,) bool."""
    straight = dot3(force, opening) >= math.cos(config.grasp_angle) * norm
    firm = (norm >= config.grasp_force) & straight
    return firm[:, 0] & firm[:, 1]


def at_goal(obj_pos: Array, goal_pos: Array, rect: Array | None, config: TaskConfig) -> Array:
    """Whether objects are at their place goals.

    Args:
        obj_pos, goal_pos: (..., 3) [m, world].
        rect: (..., 4, 2) corners of the zones, read for goal_type "zone" only.

    Raises:
        UsageError: goal_type "zone" without rectangles.
    """
    delta = obj_pos - goal_pos
    if config.goal_type == "sphere":
        return norm3(delta) <= config.goal_tol
    xp = namespace(delta)
    level = xp.abs(delta[..., 2]) <= config.goal_tol
    if config.goal_type == "cylinder":
        x, y = delta[..., 0], delta[..., 1]
        return level & (xp.sqrt(x * x + y * y) <= config.goal_tol)
    if rect is None:
        raise UsageError('goal_type "zone" needs the goal_rect of every Place in the plan; use "sphere" without them.')
    inside = level
    for neighbour in (1, 3):
        edge = rect[..., neighbour, :] - rect[..., 0, :]
        along = (obj_pos[..., 0] - rect[..., 0, 0]) * edge[..., 0] + (obj_pos[..., 1] - rect[..., 0, 1]) * edge[..., 1]
        inside = inside & (along >= 0) & (along <= edge[..., 0] * edge[..., 0] + edge[..., 1] * edge[..., 1])
    return inside


def _rest(state: WorldState, loose: Array, config: TaskConfig) -> tuple[Array, Array]:
    """Tool centre at its rest point, joints near rest. ``loose`` (W,): an object is held, the arm may give way."""
    xp = namespace(state.robot_q)
    x, y, yaw = state.base_pose[:, 0], state.base_pose[:, 1], state.base_pose[:, 2]
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    rx, ry, rz = config.ee_rest_pos
    dx = state.tcp_pos[:, 0] - (x + cos * rx - sin * ry)
    dy = state.tcp_pos[:, 1] - (y + sin * rx + cos * ry)
    dz = state.tcp_pos[:, 2] - (config.base_height + rz)
    ee_rest = xp.sqrt(dx * dx + dy * dy + dz * dz) <= config.ee_rest_tol
    off = xp.abs(state.robot_q[:, 3:13] - constant(config.rest_qpos[3:13], state.robot_q))
    torso, head_and_arm = off[:, 0], xp.max(off[:, 1:], axis=-1)
    tight = (head_and_arm <= config.arm_tol) & (torso <= config.torso_tol)
    slack = (head_and_arm <= config.arm_tol_grasped) & (torso <= config.arm_tol_grasped)
    return ee_rest, xp.where(loose, slack, tight)


def _static(state: WorldState, config: TaskConfig) -> Array:
    """Neither the base nor torso, head or arm move. Returns (W,) bool."""
    xp = namespace(state.robot_qd)
    speed = xp.abs(state.robot_qd[:, :13])
    base = xp.max(speed[:, :3], axis=-1) <= config.static_base_speed
    return base & (xp.max(speed[:, 3:], axis=-1) <= config.static_speed)


def _arrival(state: WorldState, active: _Active, config: TaskConfig) -> tuple[Array, Array]:
    """Near the navigation goal (and inside its box), and facing it. Returns two (W,) bool."""
    xp = namespace(state.base_pose)
    x, y, yaw = state.base_pose[:, 0], state.base_pose[:, 1], state.base_pose[:, 2]
    dx, dy = active.goal_pos[:, 0] - x, active.goal_pos[:, 1] - y
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    bearing = xp.atan2(cos * dy - sin * dx, cos * dx + sin * dy)
    box = active.box
    inside = (x >= box[:, 0]) & (x <= box[:, 1]) & (y >= box[:, 2]) & (y <= box[:, 3])
    near = (xp.sqrt(dx * dx + dy * dy) <= config.nav_distance) & (inside | xp.isnan(box[:, 0]))
    return near, xp.abs(bearing) <= config.nav_bearing


def _placed_ok(state: WorldState, plan: PlanArrays, pointer: Array, config: TaskConfig) -> Array:
    """Every object of a finished Place is still at its goal. Returns (W,) bool."""
    xp = namespace(pointer)
    order = xp.arange(plan.kind.shape[1], device=device_of(pointer))
    finished = (plan.kind == int(SubtaskKind.PLACE)) & (order < pointer[:, None])
    there = at_goal(state.plan_obj_pos, plan.goal_pos, plan.goal_rect, config)
    return xp.all(there | ~finished, axis=-1)


def _grip(state: WorldState, active: _Active, config: TaskConfig) -> dict[str, Array]:
    """Signals of the hand: Navigate looks at the carried object, every other kind at its target."""
    xp = namespace(state.finger_force)
    nav = active.kind == int(SubtaskKind.NAVIGATE)
    force = xp.where(nav[:, None, None], state.held_force, state.finger_force)
    norm = norm3(force)
    target_force = norm[:, 0] + norm[:, 1]
    contact = target_force > 0
    return {
        "is_grasped": _grasped(force, norm, state.finger_dir, config),
        "contact": contact,
        "touch": state.target_contact | contact,
        "target_force": target_force,
    }


def _joint(state: WorldState, active: _Active, config: TaskConfig) -> dict[str, Array]:
    """Signals of the joint of an Open or Close; False for other kinds."""
    jointed = active.kind >= int(SubtaskKind.OPEN)
    span = state.joint_max - state.joint_min
    opening = state.joint_q - state.joint_min
    moved = state.joint_start - state.joint_q
    return {
        "opened": jointed & (opening >= active.open_frac * span),
        "closed": jointed & (opening <= config.close_fraction * span),
        "slightly_opened": jointed & (opening >= config.slightly_open_fraction * span),
        "slightly_closed": jointed & (moved >= config.slightly_close_fraction * span),
    }


def measure(state: WorldState, plan: PlanArrays, progress: Progress, config: TaskConfig) -> Signals:
    """Measure the active subtask of every world.

    Args:
        state: W worlds after a control step.
        plan: their plans.
        progress: which subtask is active and the force it has accumulated, this step's included.
        config: the thresholds.

    Returns:
        Signals for the subtask at ``progress.pointer``; a world whose plan is finished has kind -1 and no success.
    """
    active = _active(state, plan, progress.pointer)
    kind, cumulative = active.kind, progress.cumulative_force
    place, nav = kind == int(SubtaskKind.PLACE), kind == int(SubtaskKind.NAVIGATE)
    must_hold = active.must_hold & nav
    ee_rest, robot_rest = _rest(state, (kind == int(SubtaskKind.PICK)) | must_hold, config)
    near, oriented = _arrival(state, active, config)
    # A finished plan has kind -1, which reads the last entry: no limit.
    limit = constant((*config.force_limits, math.inf), cumulative)[kind]
    signals = Signals(
        **_grip(state, active, config),
        **_joint(state, active, config),
        at_goal=place & at_goal(active.obj_pos, active.goal_pos, active.goal_rect, config),
        ee_rest=ee_rest,
        robot_rest=robot_rest,
        is_static=_static(state, config),
        force_ok=cumulative <= limit,
        near=nav & near,
        oriented=nav & oriented,
        robot_force=state.robot_force,
        cumulative_force=cumulative,
        success=place,  # stands in until the conditions above are combined
        placed_ok=_placed_ok(state, plan, progress.pointer, config),
        kind=kind,
        must_hold=must_hold,
    )
    return replace(signals, success=subtask_success(signals, config))


def subtask_success(signals: Signals, config: TaskConfig) -> Array:
    """Apply the success condition of each world's active kind. Returns (W,) bool; kind -1 never succeeds."""
    s = signals
    rest = (s.ee_rest, s.robot_rest, s.is_static, s.force_ok)
    hold_ok = s.is_grasped | ~s.must_hold
    by_kind = (
        done.pick_success(s.is_grasped, *rest),
        done.place_success(s.is_grasped, s.at_goal, *rest),
        done.navigate_success(s.near, s.oriented, hold_ok, *rest, ignore_arm=config.ignore_arm),
        done.open_success(s.opened, *rest),
        done.close_success(s.closed, *rest),
    )
    success = (s.kind == 0) & by_kind[0]
    for kind in range(1, 5):
        success = success | ((s.kind == kind) & by_kind[kind])
    return success
