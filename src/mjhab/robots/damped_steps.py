"""Damped least-squares steps of inverse kinematics, on numpy and torch.

The end-effector controllers and the scripted experts use them. Letters: N configurations, E numbers of the task-space
error, D joints. Lengths [m], angles [rad].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.core.arrays import Array, Table, between, constant, may_hold, namespace

DAMPING = 1e-4
"""Least damping of the normal equations. DAMPING_PER_ERROR adds more far from the goal, where linearisation is poor."""
DAMPING_PER_ERROR = 0.03
"""Damping added per squared norm of the error; the squared norm is clipped at 1."""
_EYES = {
    n: Table(tuple(tuple(float(i == k) for k in range(n)) for i in range(n)))
    for n in range(1, 7)
}


def damped_step(error: Array, jac: Array, pull: Array, damping: float = DAMPING) -> Array:
    """Compute a damped least-squares step.

    Args:
        error: (N, E) task-space error to reduce.
        jac: (N, E, D) Jacobian of D joints.
        pull: (N, D) desired joint change, applied in the null space of the task.
        damping: least damping, see DAMPING.

    Returns:
        (N, D) joint changes.
    """
    xp = namespace(error)
    # Bounded, so that a goal far away does not freeze the joints.
    size = xp.minimum(xp.sum(error * error, axis=1), constant((1.0,), error))
    # E x E and not D x D: the task has at most 6 numbers, robots have more joints.
    square = jac @ jac.swapaxes(1, 2) + (damping + DAMPING_PER_ERROR * size)[
        :, None, None
    ] * constant(_EYES[error.shape[1]], error)
    # The pull moves the tcp as well; what it does is taken off the error.
    wanted = error - xp.einsum("nij,nj->ni", jac, pull)
    return xp.einsum("nij,ni->nj", jac, _solve(square, wanted)) + pull


def _solve(square: Array, wanted: Array) -> Array:
    """Solve ``square x = wanted`` (N, E) for symmetric positive definite matrices (N, E, E); return x (N, E)."""
    if isinstance(square, np.ndarray):
        # As a matrix with one column: numpy 2 reads a stack of vectors as one matrix.
        return np.linalg.solve(square, wanted[..., None])[..., 0]
    # torch's solver waits for the device to check success. These matrices need no pivots in Gauss-Jordan elimination.
    xp = namespace(square)
    eye = constant(_EYES[wanted.shape[1]], wanted)
    both = xp.concat([square, wanted[..., None]], axis=2)
    for k in range(wanted.shape[1]):
        row = both[:, k] / both[:, k, k, None]
        both = both - (both[:, :, k] - eye[k])[..., None] * row[:, None]
    return both[..., -1]


@dataclass(frozen=True, eq=False)
class StepBounds:
    """Bounds of a joint step [m or rad].

    Attributes:
        low: (N, D) lower limit minus joint position.
        high: (N, D) upper limit minus joint position.
        largest: largest absolute change of a joint, one number or (D,).
    """

    low: Array
    high: Array
    largest: Array | float


def limited_step(
    error: Array,
    jac: Array,
    pull: Array,
    bounds: StepBounds,
    damping: float = DAMPING,
) -> Array:
    """Compute a damped least-squares step within joint limits.

    A joint that would pass its limit moves to the limit, and the step of the others is recomputed for the remaining
    error. Clipping the step alone would stall at the limits.

    Args:
        error: (N, E), see `damped_step`.
        jac: (N, E, D), see `damped_step`.
        pull: (N, D), see `damped_step`.
        bounds: limits of the step.
        damping: see `damped_step`.

    Returns:
        (N, D) joint changes.
    """
    low = bounds.low
    high = bounds.high
    xp = namespace(error)
    stopped = xp.zeros_like(pull)
    free = xp.ones_like(pull)
    # Joints that are stopped push others to their limits, so that one round is not enough.
    for last in (False, False, True):
        remaining = error - xp.einsum("nij,nj->ni", jac, stopped)
        step = _bounded(
            stopped
            + damped_step(remaining, jac * free[:, None], pull * free, damping) * free,
            bounds.largest,
        )
        over = (free > 0) & ((step < low) | (step > high))
        if last or not may_hold(over):
            break
        stopped = xp.where(over, between(step, low, high), stopped)
        free = xp.where(over, 0.0, free)
    return step


def _bounded(step: Array, largest: Array | float) -> Array:
    xp = namespace(step)
    share = xp.max(xp.abs(step) / largest, axis=1, keepdims=True)
    return step / xp.maximum(share, constant((1.0,), share))
