"""Measurement of the active subtask of every world: from physical quantities to boolean and float signals.

Distances are Euclidean, speeds absolute (unless ``stillness`` is "published"), and thresholds include equality (MS-HAB
paper App. A.2). The functions are pure, run on numpy and torch, and keep the dtype of the state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

from mjhab.core.arrays import (
    Array,
    constant,
    count,
    dot3,
    may_hold,
    namespace,
    norm3,
    pick_column,
    pile,
    value_text,
)
from mjhab.core.errors import UsageError, fault
from mjhab.core.joints import BASE, BASE_XY, BASE_YAW
from mjhab.tasks.plan import PlanArrays
from mjhab.tasks.posture import off_rest
from mjhab.tasks.signals import (
    CHECKS,
    JOINT_CHECKS,
    SIGNAL_CHECKS,
    WAY_CHECKS,
    Active,
    MeasuredProgress,
    Signals,
    WorldState,
)
from mjhab.tasks.subtasks.registry import PADDING, SUBTASKS, force_limits, properties
from mjhab.tasks.subtasks.spec import Measure
from mjhab.tasks.success import holding_checks, masks
from mjhab.tasks.thresholds import TaskConfig


def active_entries(plan: PlanArrays, pointer: Array, config: TaskConfig) -> Active:
    """Look up the entries of the subtasks at ``pointer`` (W,) int64."""
    xp = namespace(pointer)
    # A finished plan points behind its end, where there is no row to read.
    index = xp.minimum(pointer, plan.length - 1)
    kind = xp.where(pointer < plan.length, pick_column(plan.kind, index), PADDING)
    navigate, rests_holding = properties(kind, "navigates", "rests_holding")
    # The row that a finished plan reads may be of another kind.
    must_hold = pick_column(plan.must_hold, index) & navigate
    goal_pos = pick_column(plan.goal_pos, index)
    loose = rests_holding | must_hold
    tight = constant(config.rest_tolerances, goal_pos)
    order = count(plan.kind.shape[1], pointer)
    # A finished plan has kind -1, which reads the last entry: no limit.
    limits = constant(force_limits(config), goal_pos)
    applies, optional = masks(kind, config.ignore_arm)
    unfinished = ~properties(plan.kind, "keeps_goal")[0] | (order >= pointer[:, None])
    return Active(
        index=index,
        kind=kind,
        goal_pos=goal_pos,
        open_frac=pick_column(plan.open_frac, index),
        box=pick_column(plan.box, index),
        navigate=navigate,
        must_hold=must_hold,
        rest_tol=xp.where(loose[:, None], config.arm_tol_grasped, tight),
        force_limit=limits[kind],
        unfinished=unfinished,
        applies=applies,
        optional=optional,
        # Also where only a finished Place has one, which must not be undone.
        has_goals=_any_applies(applies, ("at_goal",)) or may_hold(~unfinished),
        has_joints=_any_applies(applies, JOINT_CHECKS),
        has_ways=_any_applies(applies, WAY_CHECKS),
    )


def _any_applies(applies: Array, names: Sequence[str]) -> bool:
    """Whether one of the checks ``names`` applies in some world, as far as that is free to know (`may_hold`)."""
    return any(may_hold(applies[CHECKS.index(name)]) for name in names)


def _grip(
    state: WorldState, nav: Array, config: TaskConfig
) -> tuple[Array, Array, Array]:
    """Measure the grasp: of the carried object in Navigate (``nav`` (W,) bool), else of the target.

    Returns:
        is_grasped (W,) bool: the force on both fingers is at least ``grasp_force`` and within ``grasp_angle`` of the
        opening direction; contact (W,) bool; target_force (W,) [N].
    """
    force = namespace(nav).where(nav[:, None, None], state.held_force, state.finger_force)
    norm = norm3(force)
    # Multiplied and not divided: a finger without contact has the norm 0.
    straight = dot3(force, state.finger_dir) >= math.cos(config.grasp_angle) * norm
    firm = (norm >= config.grasp_force) & straight
    target_force = norm[:, 0] + norm[:, 1]
    return firm[:, 0] & firm[:, 1], target_force > 0, target_force


def at_goal(
    obj_pos: Array, goal_pos: Array, rect: Array | None, config: TaskConfig
) -> Array:
    """Whether objects are at their place goals.

    Args:
        obj_pos: (..., 3) positions of the objects in the world [m].
        goal_pos: (..., 3) goals in the world [m].
        rect: (..., 4, 2) corners of the zones in the world [m], read for goal_type "zone" only.
        config: thresholds.

    Returns:
        (...,) bool.

    Raises:
        UsageError: goal_type "zone" without rectangles.
    """
    delta = obj_pos - goal_pos
    if config.goal_type == "sphere":
        return norm3(delta) <= config.goal_tol
    xp = namespace(delta)
    level = xp.abs(delta[..., 2]) <= config.goal_tol
    if config.goal_type == "cylinder":
        x = delta[..., 0]
        y = delta[..., 1]
        return level & (xp.sqrt(x * x + y * y) <= config.goal_tol)
    if rect is None:
        raise UsageError(
            'goal_type "zone" needs the goal_rect of every Place in the plan; use "sphere" without them.'
        )
    inside = level
    # Two neighbours of one corner span a rectangle; the fourth corner adds nothing.
    for neighbour in (1, 3):
        edge = rect[..., neighbour, :] - rect[..., 0, :]
        along = (obj_pos[..., 0] - rect[..., 0, 0]) * edge[..., 0] + (
            obj_pos[..., 1] - rect[..., 0, 1]
        ) * edge[..., 1]
        inside = (
            inside
            & (along >= 0)
            & (along <= edge[..., 0] * edge[..., 0] + edge[..., 1] * edge[..., 1])
        )
    return inside


def _nowhere(active: Active) -> Array:
    """(W,) bool, False in all worlds."""
    # Of the right library and device without asking for either.
    return active.kind != active.kind


def _goals(
    state: WorldState, plan: PlanArrays, active: Active, config: TaskConfig
) -> tuple[Array, Array]:
    """Whether the active subtask's object is at its goal, and whether those of all finished Places are: two (W,) bool.

    Where no subtask has a goal for an object, False and True.
    """
    if not active.has_goals:
        no = _nowhere(active)
        return no, ~no
    # For all subtasks of the plan, since those that are done are watched as well.
    there = at_goal(state.plan_obj_pos, plan.goal_pos, plan.goal_rect, config)  # (W, S)
    placed_ok = namespace(there).all(there | active.unfinished, axis=-1)
    return pick_column(there, active.index), placed_ok


def _rest(state: WorldState, config: TaskConfig) -> Array:
    """(W,) bool: the tcp is at its rest point."""
    base = state.base_pose
    cos = namespace(base).cos(base[:, BASE_YAW])
    sin = namespace(base).sin(base[:, BASE_YAW])
    tcp = state.tcp_pos
    rx, ry, rz = config.ee_rest_pos
    dx = tcp[:, 0] - (base[:, 0] + cos * rx - sin * ry)
    dy = tcp[:, 1] - (base[:, 1] + sin * rx + cos * ry)
    dz = tcp[:, 2] - (config.base_height + rz)
    return namespace(dx).sqrt(dx * dx + dy * dy + dz * dz) <= config.ee_rest_tol


def speed_limits(config: TaskConfig) -> tuple[float, ...]:
    """Largest speeds [m/s or rad/s] at which base, then torso, head and arm stand still."""
    posture = config.joints.posture
    moved = posture.stop - posture.start
    return (config.static_base_speed,) * BASE.stop + (config.static_speed,) * moved


def _stillness(
    state: WorldState, tolerance: Array, config: TaskConfig
) -> tuple[Array, Array]:
    """Whether torso, head and arm are near rest, and whether base, torso, head and arm stand still: two (W,) bool.

    ``tolerance`` (W, P): largest distance of the posture's joints from rest [m or rad].
    """
    xp = namespace(tolerance)
    near_rest = xp.abs(off_rest(state.robot_q, config)) <= tolerance
    limits = constant(speed_limits(config), state.robot_qd)
    speed = state.robot_qd[:, config.joints.body]
    # The published code compares the speed with its sign (is_static of ManiSkill's robot).
    if config.stillness == "absolute":
        speed = xp.abs(speed)
    slow = speed <= limits
    return near_rest.all(-1), slow.all(-1)


def _arrival(
    state: WorldState, active: Active, config: TaskConfig
) -> tuple[Array, Array]:
    """Whether the base is near the navigation goal (and inside its box), and whether it faces it: two (W,) bool.

    Both are False where no world drives.
    """
    if not active.has_ways:
        no = _nowhere(active)
        return no, no
    xp = namespace(state.base_pose)
    position = state.base_pose[:, BASE_XY]
    to_goal = active.goal_pos[:, :2] - position
    dx = to_goal[:, 0]
    dy = to_goal[:, 1]
    cos = xp.cos(state.base_pose[:, BASE_YAW])
    sin = xp.sin(state.base_pose[:, BASE_YAW])
    bearing = xp.atan2(cos * dy - sin * dx, cos * dx + sin * dy)
    # NaN stands for "no box": comparisons with NaN are False, so that no position is outside.
    outside = (position < active.box[:, ::2]) | (position > active.box[:, 1::2])
    # "Not outside" in place of "inside", which a missing box would fail.
    near = (xp.sqrt(dx * dx + dy * dy) <= config.nav_distance) & ~(
        outside[:, 0] | outside[:, 1]
    )
    return near, xp.abs(bearing) <= config.nav_bearing


def _joint(
    state: WorldState, active: Active, config: TaskConfig
) -> tuple[Array, Array, Array, Array]:
    """Whether the active link is opened, closed, slightly opened, slightly closed: four (W,) bool.

    All are False where no subtask has a link.
    """
    if not active.has_joints:
        no = _nowhere(active)
        return no, no, no, no
    span = state.joint_max - state.joint_min
    opening = state.joint_q - state.joint_min
    return (
        opening >= active.open_frac * span,
        opening <= config.close_fraction * span,
        opening >= config.slightly_open_fraction * span,
        state.joint_start - state.joint_q >= config.slightly_close_fraction * span,
    )


@dataclass(frozen=True)
class BodyChecks:
    """What `check_body` finds, (W,) bool unless said; the names are those of `Signals`."""

    is_grasped: Array
    contact: Array
    target_force: Array
    """(W,) float [N]."""
    ee_rest: Array
    robot_rest: Array
    is_static: Array


BodyCheck = Callable[[WorldState, Active, TaskConfig], BodyChecks]


def check_body(state: WorldState, active: Active, config: TaskConfig) -> BodyChecks:
    """The checks of hand and joints, which every kind of subtask has. `HostBodyCheck` is its compiled twin."""
    grip = _grip(state, active.navigate, config)
    rest = _rest(state, config)
    return BodyChecks(*grip, rest, *_stillness(state, active.rest_tol, config))


def measure(
    state: WorldState,
    plan: PlanArrays,
    progress: MeasuredProgress,
    config: TaskConfig,
    active: Active | None = None,
    check: BodyCheck | None = None,
) -> Signals:
    """Measure the active subtask of every world.

    Args:
        state: state of W worlds after a control step.
        plan: plans of the worlds.
        progress: active subtasks and their accumulated force, with that of this step.
        config: thresholds.
        active: `active_entries` at ``progress.pointer``; looked up if not given.
        check: `check_body`, or what gives the same.

    Returns:
        Signals for the subtask at ``progress.pointer``; a world whose plan is finished has kind -1 and no success.
    """
    if active is None:
        active = active_entries(plan, progress.pointer, config)
    cumulative = progress.cumulative_force
    body = (check or check_body)(state, active, config)
    is_grasped = body.is_grasped
    contact = body.contact
    there, placed_ok = _goals(state, plan, active, config)
    opened, closed, slightly_opened, slightly_closed = _joint(state, active, config)
    near, oriented = _arrival(state, active, config)
    found = {
        "is_grasped": is_grasped,
        "ee_rest": body.ee_rest,
        "robot_rest": body.robot_rest,
        "is_static": body.is_static,
        "force_ok": cumulative <= active.force_limit,
        "contact": contact,
        "touch": state.target_contact | contact,
        "ee_contact": state.ee_contact | contact,
        "at_goal": there,
        "opened": opened,
        "closed": closed,
        "slightly_opened": slightly_opened,
        "slightly_closed": slightly_closed,
        "near": near,
        "oriented": oriented,
        **holding_checks(is_grasped, active.must_hold),
    }
    # In the order of the table, whatever the order above.
    rows = [found[name] for name in CHECKS]
    checks = pile(_own_measures(rows, state, active, config)) & active.applies
    return Signals(
        **dict(zip(SIGNAL_CHECKS, checks[: len(SIGNAL_CHECKS)], strict=True)),
        robot_force=state.robot_force,
        target_force=body.target_force,
        cumulative_force=cumulative,
        success=(checks | active.optional).all(0),
        placed_ok=placed_ok,
        kind=active.kind,
        must_hold=active.must_hold,
    )


@lru_cache(maxsize=8)
def _measures(version: int) -> tuple[tuple[int, int, Measure], ...]:
    """(kind, row of CHECKS, function) for every entry of `SubtaskSpec.measures`."""
    return tuple(
        (number, CHECKS.index(name), function)
        for number, spec in enumerate(SUBTASKS.values())
        for name, function in spec.measures.items()
    )


def _own_measures(
    rows: Sequence[Array], state: WorldState, active: Active, config: TaskConfig
) -> list[Array]:
    """Checks ``rows`` in the order of CHECKS, with those of `SubtaskSpec.measures` replaced for their kinds.

    Raises:
        UsageError: a measure does not return one bool per world.
    """
    out = list(rows)
    for number, row, function in _measures(SUBTASKS.version):
        mine = active.kind == number
        # A plugin's function is not called while no world has its subtask.
        if may_hold(mine):
            own = function(state, active, config)
            # Checked in every step: a shape that broadcasts would spread one world's result to all.
            if getattr(own, "shape", None) != mine.shape or own.dtype != mine.dtype:
                raise fault(
                    SUBTASKS.described(SUBTASKS.names()[number]),
                    f"the measure of {CHECKS[row]!r} must give one bool per world, shape {tuple(mine.shape)}; "
                    f"got {value_text(own)}.",
                )
            out[row] = namespace(own).where(mine, own, out[row])
    return out
