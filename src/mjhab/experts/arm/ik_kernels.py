"""Compiled inverse kinematics: task error, Jacobian and iterations, one configuration after the other.

The results equal those of `mjhab.robots.kinematics`, which computes whole batches in numpy or torch. Here the
iterations of a configuration stop as soon as it is within the tolerances, and the loops allocate nothing. Letters:
N configurations, M goals, Q joint columns, L links, J joints from the root to the tip, D columns that may move.
Lengths [m], angles [rad], world frame.
"""

from __future__ import annotations

import numpy as np

from mjhab.experts.arm.frame_kernels import SLIDE, Tree, place_link, place_root
from mjhab.experts.arm.step_kernels import Space, make_space, set_limited_step
from mjhab.experts.jit import inline, kernel

POSE = 0
APPROACH = 1
CLOSING = 2
POSITION = 3
"""Which part of the orientation counts, see `ik.Mode`."""
MODES = {"pose": POSE, "approach": APPROACH, "closing": CLOSING, "position": POSITION}


@inline
def _rotation_error(
    wish: np.ndarray, now: np.ndarray, m: np.ndarray, out: np.ndarray
) -> None:
    """Write into ``out[3:]`` the rotation vector [rad] from rotation ``now`` (3, 3) to ``wish`` (3, 3).

    ``m`` (3, 3) is scratch memory.
    """
    for i in range(3):
        for k in range(3):
            m[i, k] = (
                wish[i, 0] * now[k, 0] + wish[i, 1] * now[k, 1] + wish[i, 2] * now[k, 2]
            )
    # Shepperd's method: of four forms of the quaternion the one with the largest pivot.
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    xy = m[1, 0] + m[0, 1]
    xz = m[0, 2] + m[2, 0]
    yz = m[2, 1] + m[1, 2]
    w = 1.0 + trace
    x = m[2, 1] - m[1, 2]
    y = m[0, 2] - m[2, 0]
    z = m[1, 0] - m[0, 1]
    twist_x = x
    twist_y = y
    twist_z = z
    best = w
    if 1.0 + 2.0 * m[0, 0] - trace > best:
        best = 1.0 + 2.0 * m[0, 0] - trace
        w, x, y, z = twist_x, best, xy, xz
    if 1.0 + 2.0 * m[1, 1] - trace > best:
        best = 1.0 + 2.0 * m[1, 1] - trace
        w, x, y, z = twist_y, xy, best, yz
    if 1.0 + 2.0 * m[2, 2] - trace > best:
        best = 1.0 + 2.0 * m[2, 2] - trace
        w, x, y, z = twist_z, xz, yz, best
    vector = np.sqrt(x * x + y * y + z * z)
    size = np.sqrt(w * w + vector * vector)
    sine = vector / size
    # The limit for small turns, where the quotient is 0 / 0.
    scale = 2.0 if sine <= 1e-9 else 2.0 * np.arctan2(sine, abs(w) / size) / sine
    # The same rotation by the shorter way.
    if w < 0.0:
        scale = -scale
    out[3] = x / size * scale
    out[4] = y / size * scale
    out[5] = z / size * scale


@inline
def _axis_error(
    rot: np.ndarray, wish: np.ndarray, column: int, axis: np.ndarray, out: np.ndarray
) -> None:
    """Write into ``out[3:]`` the rotation vector [rad] from a column of ``rot`` (3, 3) to that of ``wish`` (3, 3).

    ``axis`` (3,) is overwritten with the column of ``rot``.
    """
    for i in range(3):
        axis[i] = rot[i, column]
    cosine = 0.0
    for i in range(3):
        a = (i + 1) % 3
        b = (i + 2) % 3
        out[3 + i] = axis[a] * wish[b, column] - axis[b] * wish[a, column]
        cosine += axis[i] * wish[i, column]
    sine = np.sqrt(out[3] * out[3] + out[4] * out[4] + out[5] * out[5])
    angle = np.arctan2(sine, cosine)
    if sine < 1e-9 and angle > 1.0:
        # For opposite axes the rotation axis is undetermined: take any perpendicular one.
        if abs(axis[0]) < 0.9:
            out[3] = 0.0
            out[4] = axis[2]
            out[5] = -axis[1]
        else:
            out[3] = -axis[2]
            out[4] = 0.0
            out[5] = axis[0]
        sine = np.sqrt(out[3] * out[3] + out[4] * out[4] + out[5] * out[5])
    scale = angle / max(sine, 1e-12)
    for i in range(3, 6):
        out[i] *= scale


@kernel
def _task(
    tree: Tree,
    q: np.ndarray,
    goal_pos: np.ndarray,
    goal_rot: np.ndarray,
    mode: int,
    slot: np.ndarray,
    s: Space,
) -> None:
    """Write task error and Jacobian of configuration ``q`` (Q,) for a goal into ``s``.

    Args:
        tree: the robot.
        q: (Q,) configuration.
        goal_pos: (3,) goal position.
        goal_rot: (3, 3) goal rotation.
        mode: part of the orientation that counts, one of `MODES`.
        slot: (L - 1,) index of each joint's column among the D columns that may move, -1 if it may not.
        s: workspace; frames, ``error``, ``jac`` and ``axis`` are overwritten.
    """
    place_root(tree, s.pos, s.rot)
    for j in tree.path:
        place_link(tree, j, q, s.pos, s.rot)
    tip = tree.path[-1] + 1
    for i in range(3):
        s.error[i] = goal_pos[i] - s.pos[tip, i]
        s.error[3 + i] = 0.0
    if mode == POSE:
        _rotation_error(goal_rot, s.rot[tip], s.turn, s.error)
    elif mode != POSITION:
        _axis_error(s.rot[tip], goal_rot, mode - APPROACH, s.axis, s.error)
    for j in tree.path:
        d = slot[j]
        if d < 0:
            continue
        link = j + 1
        row = s.jac[d]
        k = tree.axis[j]
        x = tree.sign[j] * s.rot[link, 0, k]
        y = tree.sign[j] * s.rot[link, 1, k]
        z = tree.sign[j] * s.rot[link, 2, k]
        if tree.kind[j] == SLIDE:
            row[0] = x
            row[1] = y
            row[2] = z
            # A sliding joint turns nothing.
            row[3:] = 0.0
            continue
        dx = s.pos[tip, 0] - s.pos[link, 0]
        dy = s.pos[tip, 1] - s.pos[link, 1]
        dz = s.pos[tip, 2] - s.pos[link, 2]
        row[0] = y * dz - z * dy
        row[1] = z * dx - x * dz
        row[2] = x * dy - y * dx
        about = 0.0
        if mode in (APPROACH, CLOSING):
            # Rotation about the axis itself does not count: remove it from the Jacobian.
            about = x * s.axis[0] + y * s.axis[1] + z * s.axis[2]
        counts = 0.0 if mode == POSITION else 1.0
        row[3] = counts * (x - about * s.axis[0])
        row[4] = counts * (y - about * s.axis[1])
        row[5] = counts * (z - about * s.axis[2])


@kernel
def _one_step(
    tree: Tree,
    q: np.ndarray,
    rest: np.ndarray,
    rest_gain: float,
    dofs: np.ndarray,
    s: Space,
) -> None:
    """Write into ``s.step`` (D,) the damped step that reduces the task error of ``q`` (Q,) within its joint limits."""
    for d in range(len(dofs)):
        column = dofs[d]
        s.pull[d] = (rest[column] - q[column]) * rest_gain
        s.low[d] = tree.lower[column] - q[column]
        s.high[d] = tree.upper[column] - q[column]
    set_limited_step(s)


@inline
def _slots(tree: Tree, dofs: np.ndarray) -> np.ndarray:
    """Index (L - 1,) of each joint's column in ``dofs`` (D,), -1 where it is not in it."""
    slot = np.full(len(tree.parent), -1)
    for j in range(len(tree.parent)):
        for d in range(len(dofs)):
            if tree.column[j] == dofs[d]:
                slot[j] = d
    return slot


@kernel
def reach(
    tree: Tree,
    q: np.ndarray,
    goal_pos: np.ndarray,
    goal_rot: np.ndarray,
    mode: int,
    dofs: np.ndarray,
    rest: np.ndarray,
    iterations: int,
    rest_gain: float,
    max_step: float,
    pos_tolerance: float,
    rot_tolerance: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Move configurations in place towards goals, see `ik.solve`.

    Args:
        tree: the robot.
        q: (N, Q) configurations, overwritten; each goal has N / M consecutive ones.
        goal_pos: (M, 3) goal positions.
        goal_rot: (M, 3, 3) goal rotations.
        mode: part of the orientation that counts, one of `MODES`.
        dofs: (D,) columns that may move.
        rest: (Q,) preferred posture.
        iterations: largest number of iterations per configuration.
        rest_gain: gain of the null space in the first iteration; it falls to 0 after two thirds of the iterations.
        max_step: largest change of a column per iteration.
        pos_tolerance: position error at which, together with ``rot_tolerance``, the iterations end.
        rot_tolerance: orientation error.

    Returns:
        Remaining errors (N,) [m] and (N,) [rad].
    """
    pos_err = np.empty(len(q))
    rot_err = np.empty(len(q))
    slot = _slots(tree, dofs)
    s = make_space(tree, len(dofs))
    s.largest[:] = max_step
    # All seeds of a goal lie behind each other.
    shared = len(q) // max(len(goal_pos), 1)
    for n in range(len(q)):
        now = q[n]
        goal = n // shared
        for iteration in range(iterations + 1):
            _task(tree, now, goal_pos[goal], goal_rot[goal], mode, slot, s)
            pos_err[n] = np.sqrt(s.error[0] ** 2 + s.error[1] ** 2 + s.error[2] ** 2)
            rot_err[n] = np.sqrt(s.error[3] ** 2 + s.error[4] ** 2 + s.error[5] ** 2)
            there = pos_err[n] <= pos_tolerance and rot_err[n] <= rot_tolerance
            if there or iteration == iterations:
                break
            # The pull towards rest fades out, as it keeps the tip off its goal.
            gain = rest_gain * max(0.0, 1.0 - 1.5 * iteration / iterations)
            _one_step(tree, now, rest, gain, dofs, s)
            for d in range(len(dofs)):
                column = dofs[d]
                moved = now[column] + s.step[d]
                now[column] = min(max(moved, tree.lower[column]), tree.upper[column])
    return pos_err, rot_err


@kernel
def servo_steps(
    tree: Tree,
    ahead: np.ndarray,
    q: np.ndarray,
    goal_pos: np.ndarray,
    goal_rot: np.ndarray,
    mode: int,
    dofs: np.ndarray,
    rest: np.ndarray,
    rest_gain: float,
    largest: np.ndarray,
) -> np.ndarray:
    """Changes (N, Q) of configurations ``q`` (N, Q) in one control step, see `ik.servo`.

    Args:
        tree: the robot.
        ahead: (N, Q) the configurations with the base poses expected after the step; the error is computed here.
        q: (N, Q) present configurations.
        goal_pos: (N, 3) goal positions.
        goal_rot: (N, 3, 3) goal rotations.
        mode: part of the orientation that counts, one of `MODES`.
        dofs: (D,) columns that may move.
        rest: (Q,) preferred posture.
        rest_gain: gain of the null space.
        largest: (Q,) largest change of each column.
    """
    delta = np.zeros(q.shape)
    slot = _slots(tree, dofs)
    s = make_space(tree, len(dofs))
    for d in range(len(dofs)):
        s.largest[d] = largest[dofs[d]]
    for n in range(len(q)):
        _task(tree, ahead[n], goal_pos[n], goal_rot[n], mode, slot, s)
        _one_step(tree, q[n], rest, rest_gain, dofs, s)
        for d in range(len(dofs)):
            # A joint that is beyond its limit may stay there, and is not pushed back in one step.
            step = min(max(s.step[d], min(s.low[d], 0.0)), max(s.high[d], 0.0))
            delta[n, dofs[d]] = step
    return delta
