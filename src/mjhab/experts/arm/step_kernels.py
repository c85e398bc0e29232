"""Compiled damped least squares: the bounded step of one configuration that reduces its task error.

The arithmetic is that of `robots.damped_steps.limited_step`, for one configuration at a time. Letters: D columns that
may move, L links.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.experts.arm.frame_kernels import Tree
from mjhab.experts.jit import inline
from mjhab.robots.damped_steps import DAMPING, DAMPING_PER_ERROR


class Space(NamedTuple):
    """Workspace for one configuration, allocated once per kernel call so that the loops allocate nothing.

    Attributes:
        pos: (L, 3) link positions in the world [m].
        rot: (L, 3, 3) link rotations.
        turn: (3, 3) rotation from the present to the goal orientation.
        axis: (3,) direction of the tip's axis that counts.
        error: (6,) task error: translation [m] and rotation vector [rad].
        jac: (D, 6) transposed Jacobian.
        pull: (D,) step towards the preferred posture, applied in the null space.
        low: (D,) lower bound of the step, from the joint limits.
        high: (D,) upper bound of the step.
        largest: (D,) largest magnitude of the step.
        step: (D,) result.
        stopped: (D,) step of the columns that are fixed at a bound, else 0.
        free: (D,) bool, columns that are not fixed at a bound.
        remaining: (6,) task error after the steps of the fixed columns.
        wanted: (6,) right-hand side, then solution, of the damped normal equations.
        square: (6, 6) matrix of the damped normal equations; overwritten by its Cholesky factor.
    """

    pos: np.ndarray
    rot: np.ndarray
    turn: np.ndarray
    axis: np.ndarray
    error: np.ndarray
    jac: np.ndarray
    pull: np.ndarray
    low: np.ndarray
    high: np.ndarray
    largest: np.ndarray
    step: np.ndarray
    stopped: np.ndarray
    free: np.ndarray
    remaining: np.ndarray
    wanted: np.ndarray
    square: np.ndarray


@inline
def make_space(tree: Tree, columns: int) -> Space:
    """Allocate the workspace for a robot with ``columns`` columns that may move."""
    links = len(tree.parent) + 1
    return Space(
        np.empty((links, 3)),
        np.empty((links, 3, 3)),
        np.empty((3, 3)),
        # Zeros, not np.empty: where no axis counts it is multiplied by 0, which leaves NaN as NaN.
        np.zeros(3),
        np.empty(6),
        np.zeros((columns, 6)),
        np.empty(columns),
        np.empty(columns),
        np.empty(columns),
        np.empty(columns),
        np.empty(columns),
        np.empty(columns),
        np.empty(columns, np.bool_),
        np.empty(6),
        np.empty(6),
        np.empty((6, 6)),
    )


@inline
def _solve(square: np.ndarray, x: np.ndarray) -> None:
    """Solve ``square @ y = x`` by Cholesky factorisation and write ``y`` into ``x`` (6,).

    ``square`` (6, 6) is positive definite; its lower triangle is overwritten.
    """
    for i in range(6):
        for k in range(i + 1):
            value = square[i, k]
            for m in range(k):
                value -= square[i, m] * square[k, m]
            square[i, k] = np.sqrt(value) if i == k else value / square[k, k]
    for i in range(6):
        for m in range(i):
            x[i] -= square[i, m] * x[m]
        x[i] /= square[i, i]
    for i in range(5, -1, -1):
        for m in range(i + 1, 6):
            x[i] -= square[m, i] * x[m]
        x[i] /= square[i, i]


@inline
def _set_damped_step(s: Space) -> None:
    """Write the damped step of the free columns for ``s.remaining`` into ``s.step``, see `damped_steps.damped_step`."""
    size = 0.0
    for i in range(6):
        size += s.remaining[i] * s.remaining[i]
        s.wanted[i] = s.remaining[i]
        for k in range(i + 1):
            s.square[i, k] = 0.0
    for d in range(len(s.step)):
        if not s.free[d]:
            continue
        row = s.jac[d]
        for i in range(6):
            s.wanted[i] -= row[i] * s.pull[d]
            for k in range(i + 1):
                s.square[i, k] += row[i] * row[k]
    for i in range(6):
        # On the diagonal, which makes the matrix positive definite whatever the posture.
        s.square[i, i] += DAMPING + DAMPING_PER_ERROR * min(size, 1.0)
    _solve(s.square, s.wanted)
    for d in range(len(s.step)):
        s.step[d] = 0.0
        if s.free[d]:
            s.step[d] = s.pull[d]
            for i in range(6):
                s.step[d] += s.jac[d, i] * s.wanted[i]


@inline
def set_limited_step(s: Space) -> None:
    """Write the step within the bounds ``s.low``, ``s.high`` into ``s.step``, see `damped_steps.limited_step`."""
    columns = len(s.step)
    s.stopped[:] = 0.0
    s.free[:] = True
    for attempt in range(3):
        for i in range(6):
            s.remaining[i] = s.error[i]
            for d in range(columns):
                s.remaining[i] -= s.jac[d, i] * s.stopped[d]
        _set_damped_step(s)
        share = 1.0
        for d in range(columns):
            s.step[d] += s.stopped[d]
            # One factor for all joints, so that the tip keeps its direction.
            share = max(share, abs(s.step[d]) / s.largest[d])
        over = False
        for d in range(columns):
            s.step[d] /= share
            over = over or (s.free[d] and (s.step[d] < s.low[d] or s.step[d] > s.high[d]))
        if attempt == 2 or not over:
            break
        for d in range(columns):
            if s.free[d] and (s.step[d] < s.low[d] or s.step[d] > s.high[d]):
                s.stopped[d] = min(max(s.step[d], s.low[d]), s.high[d])
                s.free[d] = False
