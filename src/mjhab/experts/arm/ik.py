"""Inverse kinematics in batches by damped least squares.

`solve` finds configurations for many goals from many seeds at once; `servo` computes the joint motion of one control
step that moves the tip towards a pose, also while the base drives. Letters: M goals, S seeds, N configurations,
Q joint columns, D columns that may move.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mjhab.core.joints import BASE
from mjhab.core.kernels.arrays import read_only
from mjhab.core.rotations import mat_from_rotation_vector, rotation_vector, wrap
from mjhab.experts.arm import ik_kernels
from mjhab.experts.arm.frame_kernels import tree_of
from mjhab.robots.kinematics import Chain

Mode = Literal["pose", "approach", "closing", "position"]
"""Which part of the goal orientation counts: all of it ("pose"), only the direction of the gripper's x axis
("approach"), only that of its y axis, along which the fingers close ("closing"), or none ("position")."""

ARM_STEP_RAD = 0.038
"""Motion of an arm joint in one control step of 50 ms at a full command: with kp 1e3 and kd 1e2, a joint covers
0.1 (1 - exp(-0.5)) rad of the way to a target 0.1 rad ahead."""
TORSO_STEP_M = 0.02
"""Motion that the torso reliably makes in one control step; the weight of the arm makes it slower than the arm."""


@dataclass(frozen=True, eq=False)
class TipGoals:
    """Goals of the tip, and what may move to reach them.

    Attributes:
        pos: (M, 3) positions in the world [m].
        rot: (M, 3, 3) rotations; ``mode`` "approach" uses only column 0, "closing" only column 1.
        dofs: (D,) columns that may move, see `columns`.
        rest: (Q,) preferred posture, approached in the null space.
        mode: which part of the orientation counts.
    """

    pos: np.ndarray
    rot: np.ndarray
    dofs: np.ndarray
    rest: np.ndarray
    mode: Mode = "pose"


@dataclass(frozen=True)
class Options:
    """Options of `solve`.

    Attributes:
        iterations: largest number of iterations per goal and seed.
        rest_gain: share of the difference to the preferred posture that one iteration takes out in the null space.
        max_step: largest change of a column per iteration [m or rad].
        pos_tolerance: position error [m] at which, together with ``rot_tolerance``, the iterations end.
        rot_tolerance: orientation error [rad].
    """

    iterations: int = 40
    rest_gain: float = 0.05
    max_step: float = 0.35
    pos_tolerance: float = 1e-3
    rot_tolerance: float = 1e-2


@dataclass(frozen=True, eq=False)
class Solutions:
    """Results of `solve` for every goal and seed.

    Attributes:
        q: (M, S, Q) configurations.
        pos_err: (M, S) remaining position errors [m].
        rot_err: (M, S) remaining orientation errors [rad].
        ok: (M, S) bool, whether both errors are within three times the tolerances.
    """

    q: np.ndarray
    pos_err: np.ndarray
    rot_err: np.ndarray
    ok: np.ndarray

    def best(self, cost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Select the valid solution with the least cost for every goal.

        Args:
            cost: (M, S), e.g. `travel_steps` from the present configuration.

        Returns:
            Configurations (M, Q) and their cost (M,), which is inf for goals without a valid solution.
        """
        masked = np.where(self.ok, cost, np.inf)
        pick = np.argmin(masked, axis=1)
        rows = np.arange(len(pick))
        return self.q[rows, pick], masked[rows, pick]


def columns(chain: Chain, *, torso: bool = True, base: bool = False) -> np.ndarray:
    """Configuration columns (D,) of the arm and, as asked for, of the torso and the base."""
    groups = ("arm", *(("torso",) if torso else ()), *(("base",) if base else ()))
    return chain.columns_of(
        [name for group in groups for name in chain.groups.get(group, ())]
    )


def random_seeds(
    chain: Chain,
    q: np.ndarray,
    dofs: np.ndarray,
    count: int,
    rng: np.random.Generator,
    spread: float = 0.8,
) -> np.ndarray:
    """Draw start configurations for `solve`.

    Args:
        chain: the robot.
        q: (Q,) configuration that is the first seed.
        dofs: (D,) columns that vary; continuous joints stay within half a turn of ``q``.
        count: number of seeds.
        rng: source of random numbers.
        spread: standard deviation [m or rad] of the seeds near ``q``, reduced for joints with small ranges.

    Returns:
        (count, Q) seeds inside the limits: ``q``, then about half normally distributed around it, the rest uniform.
    """
    seeds = np.repeat(np.asarray(q, dtype=np.float64)[None], count, axis=0)
    # Joints without limits get a turn around the present angle.
    low = np.maximum(chain.lower[dofs], q[dofs] - np.pi)
    high = np.minimum(chain.upper[dofs], q[dofs] + np.pi)
    # Near seeds give short motions of the arm, far ones other branches of the inverse kinematics.
    near = (count - 1) // 2
    # A joint with little room is not spread over its limits.
    scale = spread * np.minimum(1.0, (high - low) / 2)
    seeds[1 : 1 + near, dofs] += rng.normal(0.0, 1.0, (near, len(dofs))) * scale
    far = count - 1 - near
    seeds[1 + near :, dofs] = rng.uniform(low, high, (far, len(dofs)))
    return chain.clip(seeds)


def solve(
    chain: Chain,
    goals: TipGoals,
    seeds: np.ndarray,
    options: Options | None = None,
) -> Solutions:
    """Find configurations that bring the tip to goals.

    Args:
        chain: the robot; a chain without extra links is faster.
        goals: M goals, and what may move.
        seeds: (S, Q) or (M, S, Q) start configurations; columns that may not move keep their values.
        options: iteration limits and tolerances.

    Returns:
        One configuration per goal and seed, inside the joint limits, with its remaining errors.
    """
    options = options or Options()
    seeds = np.asarray(seeds, dtype=np.float64)
    shape = (len(goals.pos), seeds.shape[-2])
    flat = chain.clip(
        np.broadcast_to(seeds, (*shape, seeds.shape[-1])).reshape(shape[0] * shape[1], -1)
    )
    pos_err, rot_err = ik_kernels.reach(
        tree_of(chain),
        flat,
        read_only(goals.pos),
        read_only(goals.rot),
        ik_kernels.MODES[goals.mode],
        goals.dofs,
        read_only(goals.rest),
        options.iterations,
        options.rest_gain,
        options.max_step,
        options.pos_tolerance,
        options.rot_tolerance,
    )
    # Wider than where the iterations stop: a joint at its limit ends a little before.
    ok = (pos_err <= 3 * options.pos_tolerance) & (rot_err <= 3 * options.rot_tolerance)
    return Solutions(
        flat.reshape(*shape, -1),
        pos_err.reshape(shape),
        rot_err.reshape(shape),
        ok.reshape(shape),
    )


def servo(
    chain: Chain,
    q: np.ndarray,
    goals: TipGoals,
    *,
    base_next: np.ndarray | None = None,
    rest_gain: float = 0.02,
) -> np.ndarray:
    """Compute the joint motion of one control step that moves the tip towards a pose.

    The pose error is computed for the base pose expected after the step (feed-forward). The arm thus compensates the
    motion of the base, and the tip stays on a handle or a straight line while the base drives at up to 0.1 m/s; at
    higher speeds the joint speeds limit it.

    Args:
        chain: the robot.
        q: (N, Q) present configurations, base columns in the world.
        goals: pose of the tip at the end of the step for each of them, and what may move, without base columns; goals
            a few centimetres apart give a straight path.
        base_next: (N, 3) x, y [m], yaw [rad] of the base expected after the step; None if the base stands.
        rest_gain: share of the difference to the preferred posture that the step takes out in the null space.

    Returns:
        (N, Q) changes of the columns, zero for those that may not move, inside the joint limits, and scaled together
        so that no joint exceeds `ARM_STEP_RAD` or `TORSO_STEP_M`.
    """
    # Written to, as in `solve`: the kernels they share are compiled once.
    q = np.array(q, np.float64, order="C", ndmin=2)
    # The error is that after the step: the base moves meanwhile.
    ahead = q
    if base_next is not None:
        ahead = q.copy()
        ahead[:, BASE] = base_next
    return ik_kernels.servo_steps(
        tree_of(chain),
        ahead,
        q,
        read_only(goals.pos),
        read_only(goals.rot),
        ik_kernels.MODES[goals.mode],
        goals.dofs,
        read_only(goals.rest),
        rest_gain,
        step_limits(chain),
    )


def step_limits(chain: Chain) -> np.ndarray:
    """Largest change (Q,) of every column in one control step: `ARM_STEP_RAD`, for the torso `TORSO_STEP_M`."""
    limits = np.full(chain.size, ARM_STEP_RAD)
    limits[chain.columns_of(chain.groups.get("torso", ()))] = TORSO_STEP_M
    return limits


def travel_steps(
    chain: Chain, start: np.ndarray, end: np.ndarray, dofs: np.ndarray
) -> np.ndarray:
    """Control steps (...,) that the slowest joint needs from ``start`` (Q,) to ``end`` (..., Q)."""
    return np.max(np.abs(end - start)[..., dofs] / step_limits(chain)[dofs], axis=-1)


def unwind(chain: Chain, q: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """``q`` (..., Q) with continuous joints shifted by whole turns to within half a turn of ``reference`` (Q,)."""
    endless = ~np.isfinite(chain.lower)
    return np.where(endless, reference + wrap(q - reference), q)


def straight_line(
    pos: np.ndarray,
    goal: np.ndarray,
    rot: np.ndarray,
    goal_rot: np.ndarray,
    reach: float,
    turn: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the next pose on the straight path from a pose to a goal pose.

    Args:
        pos: (N, 3) present positions [m].
        goal: (N, 3) goal positions [m].
        rot: (N, 3, 3) present rotations.
        goal_rot: (N, 3, 3) goal rotations.
        reach: largest translation [m].
        turn: largest rotation [rad].

    Returns:
        Positions (N, 3) and rotations (N, 3, 3). Translation and rotation advance by the same share of what remains,
        so that both end together.
    """
    offset = goal - pos
    spin = rotation_vector(goal_rot @ rot.swapaxes(-1, -2))
    far = np.linalg.norm(offset, axis=1) / reach
    wide = np.linalg.norm(spin, axis=1) / turn
    # The slower of both sets the pace, so that hand and turn arrive together.
    share = 1.0 / np.maximum(np.maximum(far, wide), 1.0)
    return pos + share[:, None] * offset, mat_from_rotation_vector(
        share[:, None] * spin
    ) @ rot
