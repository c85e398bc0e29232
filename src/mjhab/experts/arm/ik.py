"""Inverse kinematics in batches: damped least squares for goals, one bounded step for tracking.

`solve` finds configurations for many goals from many seeds at once; `servo` gives the joint motion of one control
step that brings the tip towards a pose while the base moves. Letters: M goals, S seeds, N configurations,
Q joint columns, D columns that may move.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mjhab.core.joints import BASE
from mjhab.experts.arm import ik_kernels
from mjhab.experts.arm.frame_kernels import tree_of
from mjhab.robots.kinematics import Chain, rotate, rotation_vector, wrap

Array = np.ndarray
Mode = Literal["pose", "approach", "closing", "position"]
"""Which orientation counts: all of it, only the gripper's x axis, only its y axis (the fingers' line), or none."""

ARM_STEP_RAD = 0.038
"""Joint motion of one control step at a full arm command: with kp 1e3 and kd 1e2, a joint covers 0.1 (1 -
exp(-0.5)) rad of the way to a target 0.1 rad ahead in 50 ms."""
TORSO_STEP_M = 0.02
"""Motion of the torso in one control step that it makes reliably: it carries the arm and follows more slowly."""


@dataclass(frozen=True)
class Options:
    """How `solve` iterates. ``rest_gain``: share of the way to the preferred posture taken per iteration within the
    null space; ``max_step``: largest change of a column per iteration; tolerances end the work on a goal early."""

    iterations: int = 40
    rest_gain: float = 0.05
    max_step: float = 0.35
    pos_tolerance: float = 1e-3
    rot_tolerance: float = 1e-2


@dataclass(frozen=True, eq=False)
class Solutions:
    """``q`` (M, S, Q); ``pos_err`` [m], ``rot_err`` [rad] and ``ok`` (M, S): within three times the tolerances."""

    q: Array
    pos_err: Array
    rot_err: Array
    ok: Array

    def best(self, cost: Array) -> tuple[Array, Array]:
        """The cheapest valid seed of every goal: configurations (M, Q) and their cost (M,), inf where none is valid.

        Args:
            cost: (M, S), e.g. `travel_steps` from the present configuration.
        """
        masked = np.where(self.ok, cost, np.inf)
        pick = np.argmin(masked, axis=1)
        rows = np.arange(len(pick))
        return self.q[rows, pick], masked[rows, pick]


def columns(chain: Chain, *, torso: bool = True, base: bool = False) -> Array:
    """Columns (D,) of the arm and, if asked for, of the torso and of the base."""
    groups = ("arm", *(("torso",) if torso else ()), *(("base",) if base else ()))
    return chain.columns_of([name for group in groups for name in chain.groups.get(group, ())])


def random_seeds(
    chain: Chain, q: Array, dofs: Array, count: int, rng: np.random.Generator, spread: float = 0.8
) -> Array:
    """Seeds (count, Q) around ``q`` (Q,): the first is ``q``, half the rest are near it, half anywhere in the limits.

    Only the columns ``dofs`` vary; continuous joints stay within half a turn of ``q``.
    """
    seeds = np.repeat(np.asarray(q, dtype=np.float64)[None], count, axis=0)
    low = np.maximum(chain.lower[dofs], q[dofs] - np.pi)
    high = np.minimum(chain.upper[dofs], q[dofs] + np.pi)
    near = (count - 1) // 2
    scale = spread * np.minimum(1.0, (high - low) / 2)
    seeds[1 : 1 + near, dofs] += rng.normal(0.0, 1.0, (near, len(dofs))) * scale
    far = count - 1 - near
    seeds[1 + near :, dofs] = rng.uniform(low, high, (far, len(dofs)))
    return chain.clip(seeds)


def solve(
    chain: Chain,
    pos: Array,
    rot: Array,
    seeds: Array,
    dofs: Array,
    *,
    rest: Array,
    mode: Mode = "pose",
    options: Options | None = None,
) -> Solutions:
    """Find configurations that bring the tip to goals.

    Args:
        chain: the robot; pass one without extra links, they only cost time.
        pos: (M, 3) goal positions in the world [m].
        rot: (M, 3, 3) goal rotations; with ``mode`` "approach" or "closing" only that column is used.
        seeds: (S, Q) or (M, S, Q) start configurations; columns outside ``dofs`` keep their values.
        dofs: (D,) columns that may move, see `columns`.
        rest: (Q,) preferred posture, approached in the null space.
        mode: which part of the orientation counts.
        options: iteration limits and tolerances.

    Returns:
        One configuration per goal and seed, inside the joint limits, with the error it is left with.
    """
    options = options or Options()
    seeds = np.asarray(seeds, dtype=np.float64)
    shape = (len(pos), seeds.shape[-2])
    flat = chain.clip(
        np.broadcast_to(seeds, (*shape, seeds.shape[-1])).reshape(shape[0] * shape[1], -1)
    )
    pos_err, rot_err = ik_kernels.reach(
        tree_of(chain),
        flat,
        _floats(pos),
        _floats(rot),
        ik_kernels.MODES[mode],
        dofs,
        _floats(rest),
        options.iterations,
        options.rest_gain,
        options.max_step,
        options.pos_tolerance,
        options.rot_tolerance,
    )
    ok = (pos_err <= 3 * options.pos_tolerance) & (rot_err <= 3 * options.rot_tolerance)
    return Solutions(
        flat.reshape(*shape, -1), pos_err.reshape(shape), rot_err.reshape(shape), ok.reshape(shape)
    )


@dataclass(frozen=True)
class ServoOptions:
    """How `servo` moves.

    ``mode``: which part of the orientation counts. ``rest_gain``: share of the way to the preferred posture per step.
    """

    mode: Mode = "pose"
    rest_gain: float = 0.02


USUAL_SERVO = ServoOptions()


def servo(
    chain: Chain,
    q: Array,
    pos: Array,
    rot: Array,
    dofs: Array,
    *,
    rest: Array,
    base_next: Array | None = None,
    options: ServoOptions = USUAL_SERVO,
) -> Array:
    """Joint motion (N, Q) of one control step that brings the tip towards a pose, bounded by the joints' speed.

    The error is taken where the base *will be*: the arm makes up for the motion of the base (feed-forward), and the
    tip can stay on a handle or on a straight line while the base drives (up to 0.1 m/s; joint speeds end it).

    Args:
        chain: the robot.
        q: (N, Q) present configurations, base columns in the world.
        pos: (N, 3) where the tip should be at the end of the step [m]. Ask for points a few centimetres apart for a
            straight path.
        rot: (N, 3, 3) rotation at the end of the step.
        dofs: (D,) columns that may move; base columns do not belong here.
        rest: (Q,) posture approached in the null space.
        base_next: (N, 3) x, y, yaw expected after the step; None: the base stands.
        options: what counts, and how much.

    Returns:
        Changes of the columns, zero outside ``dofs``; scaled together so that no joint exceeds `ARM_STEP_RAD` or
        `TORSO_STEP_M`, and kept inside the joint limits.
    """
    q = np.atleast_2d(_floats(q))
    ahead = q
    if base_next is not None:
        ahead = q.copy()
        ahead[:, BASE] = base_next
    return ik_kernels.servo_steps(
        tree_of(chain),
        ahead,
        q,
        _floats(pos),
        _floats(rot),
        ik_kernels.MODES[options.mode],
        dofs,
        _floats(rest),
        options.rest_gain,
        step_limits(chain),
    )


def step_limits(chain: Chain) -> Array:
    """Largest change (Q,) of every column in one control step: `ARM_STEP_RAD`, for the torso `TORSO_STEP_M`."""
    limits = np.full(chain.size, ARM_STEP_RAD)
    limits[chain.columns_of(chain.groups.get("torso", ()))] = TORSO_STEP_M
    return limits


def travel_steps(chain: Chain, start: Array, end: Array, dofs: Array) -> Array:
    """Control steps (...,) that the slowest joint needs from ``start`` (Q,) to ``end`` (..., Q)."""
    return np.max(np.abs(end - start)[..., dofs] / step_limits(chain)[dofs], axis=-1)


def unwind(chain: Chain, q: Array, reference: Array) -> Array:
    """``q`` (..., Q) with continuous joints moved by whole turns to lie next to ``reference`` (Q,)."""
    endless = ~np.isfinite(chain.lower)
    return np.where(endless, reference + wrap(q - reference), q)


def straight_line(
    pos: Array, goal: Array, rot: Array, goal_rot: Array, reach: float, turn: float
) -> tuple[Array, Array]:
    """The next pose on the straight way to a goal: at most ``reach`` [m] and ``turn`` [rad] away.

    Args:
        pos, rot: (N, 3) and (N, 3, 3) present pose; ``goal``, ``goal_rot`` the same shapes.

    Returns:
        Position and rotation; turning and moving keep the same share of their way, so both end together.
    """
    way = goal - pos
    spin = rotation_vector(goal_rot @ rot.swapaxes(-1, -2))
    far = np.linalg.norm(way, axis=1) / reach
    wide = np.linalg.norm(spin, axis=1) / turn
    share = 1.0 / np.maximum(np.maximum(far, wide), 1.0)
    return pos + share[:, None] * way, rotate(share[:, None] * spin) @ rot


def _floats(values: Array) -> Array:
    """An array as the kernels take it."""
    return np.ascontiguousarray(values, dtype=np.float64)
