"""End-effector modes: tcp poses in the frame of `Robot.arm_root` become arm joint positions by damped least squares."""

from __future__ import annotations

from typing import Literal

import numpy as np

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.arrays import Array, between, constant, namespace, zeros
from mjhab.core.conventions.hand_turns import maniskill_turn
from mjhab.core.rotations import mat_from_rotation_vector, rotation_vector
from mjhab.robots.controllers.arm import ArmRequest, CommandedArm
from mjhab.robots.controllers.table import ActionEntry
from mjhab.robots.damped_steps import StepBounds, limited_step
from mjhab.robots.kinematics import Chain

Start = Literal["measured", "target", "absolute"]
"""Reference of a command: the measured tcp pose, the previous target, or the frame of `Robot.arm_root`."""

ITERATIONS = 3
"""Damped least-squares steps per control step. The error is then micrometres for motions of centimetres; for the
largest commands (0.1 m along each axis and 0.1 rad) from random postures its median is 0.4 mm and 4 mrad. Absolute
goals farther away take several control steps."""
LARGEST_STEP = 0.2
"""Largest change [rad] of a joint in one least-squares step; prevents jumps near singular postures."""
LEVER = 0.03
"""Weight of orientation errors against position errors [m/rad]; small: at joint limits position has priority."""
DAMPING = 1e-5
"""Damping near the goal: small enough to converge, large enough for smooth motion along joint limits. `limited_step`
adds more far from the goal."""
_AXES = ("x", "y", "z")
_WEIGHTS = (1.0, 1.0, 1.0, LEVER, LEVER, LEVER)


class EndEffector(CommandedArm):
    """Arm controller for changes of the tcp pose, or absolute tcp poses. Orientations are rotation vectors [rad].

    The target is always a posture within the joint limits, so that it does not wind up beyond the workspace.

    Args:
        request: robot, worlds and limits.
        start: reference of a command, see `Start`.
        rotates: False for position-only commands of three entries; the orientation then follows from the smallest joint
            motion, as in ManiSkill's position-only inverse kinematics.
        own_axes: changes are along and about the axes of the tcp frame instead of those of `Robot.arm_root`
            (``pd_ee_delta_pose_align``).
        as_maniskill: turns are what ManiSkill 3 makes of the same numbers (mani_skill/agents/controllers/
            pd_ee_pose.py): three angles about the axes x, y, z, and backwards, because it scales them by the lower
            bound of the turn (its issue #1469).
    """

    def __init__(
        self,
        request: ArmRequest,
        *,
        start: Start,
        rotates: bool = True,
        own_axes: bool = False,
        as_maniskill: bool = False,
    ) -> None:
        super().__init__(request, _rows(request, start, rotates, own_axes))
        self.remembers = start != "measured"
        self._start = start
        self._rotates = rotates
        self._own_axes = own_axes
        self._as_maniskill = as_maniskill
        self._turn = request.limits.ee_turn
        # From the torso on: base and torso follow their own entries of the action.
        self._chain = request.robot.arm_chain

    def command(self, move: Array, q: Array) -> Array:
        # Measured joints may be a little beyond their limits, from where the solver would not return.
        begin = between(self.target if self.remembers else q, self.low, self.high)
        self.target = self._solve(*self._goal(move, begin), begin)
        return self.target

    def still(self, q: Array) -> Array:
        if self._start != "absolute":
            return super().still(q)
        pos, rot = self._chain.tip_pose(self.target)
        return namespace(pos).concat([pos, rotation_vector(rot)], axis=1)

    def _goal(self, move: Array, begin: Array) -> tuple[Array, Array]:
        """Return the goal position (W, 3) [m] and rotation (W, 3, 3) in the frame of `Robot.arm_root`."""
        if self._start == "absolute":
            return move[:, :3], mat_from_rotation_vector(move[:, 3:])
        pos, rot = self._chain.tip_pose(begin)
        if not self._rotates:
            return pos + move, rot
        xp = namespace(move)
        length = xp.sqrt(xp.sum(move[:, 3:] ** 2, axis=1, keepdims=True))
        # By the length, so that the axis of the turn stays as it is.
        limited = move[:, 3:] * (
            self._turn / xp.maximum(length, constant((self._turn,), length))
        )
        turn = (
            maniskill_turn(limited)
            if self._as_maniskill
            else mat_from_rotation_vector(limited)
        )
        if self._own_axes:
            # Own axes turn from the right, those of the root from the left.
            return pos + (rot @ move[:, :3, None])[..., 0], rot @ turn
        return pos + move[:, :3], turn @ rot

    def _solve(self, pos: Array, rot: Array, q: Array) -> Array:
        xp = namespace(q)
        # Without a turn in the command the orientation is free, which leaves the arm more room.
        rows = 6 if self._rotates else 3
        for _ in range(ITERATIONS):
            frames = self._chain.forward(q)
            jac = self._chain.jacobian(q, frames)[:, :rows]
            error = pos - frames.pos[:, self._chain.tip_index]
            if self._rotates:
                # The turn that is left, in the axes of the root, as the Jacobian has it.
                spin = rotation_vector(
                    rot @ frames.rot[:, self._chain.tip_index].swapaxes(1, 2)
                )
                error = xp.concat([error, LEVER * spin], axis=1)
                jac = jac * constant(_WEIGHTS, jac)[:, None]
            bounds = StepBounds(self.low - q, self.high - q, LARGEST_STEP)
            step = limited_step(error, jac, zeros(q.shape, q), bounds, DAMPING)
            # Rounding may leave a joint just beyond the bound that it was stopped at.
            q = between(q + step, self.low, self.high)
        return q


def _rows(
    request: ArmRequest, start: Start, rotates: bool, own_axes: bool
) -> tuple[ActionEntry, ...]:
    robot = request.robot
    limits = request.limits
    link = robot.tcp
    root = robot.arm_root
    if start == "absolute":
        center, reach = _workspace(robot.arm_chain)
        places = [
            ActionEntry(
                f"ee_{axis}",
                link,
                c - reach,
                c + reach,
                "m",
                f"{root}, absolute",
                normalized=False,
            )
            for axis, c in zip(_AXES, center, strict=True)
        ]
        turns = [
            ActionEntry(
                f"ee_r{axis}",
                link,
                -np.pi,
                np.pi,
                "rad",
                f"{root}, rotation vector",
                normalized=False,
            )
            for axis in _AXES
        ]
        return (*places, *turns)
    frame = f"{link if own_axes else root} axes, from {'measured' if start == 'measured' else 'previous target'}"
    move = limits.ee_move
    turn = limits.ee_turn
    rows = [ActionEntry(f"ee_{axis}", link, -move, move, "m", frame) for axis in _AXES]
    if rotates:
        rows += [
            ActionEntry(f"ee_r{axis}", link, -turn, turn, "rad", f"{frame}, norm-clipped")
            for axis in _AXES
        ]
    return tuple(rows)


def _workspace(chain: Chain) -> tuple[tuple[float, ...], float]:
    """Return centre (3,) and radius [m] of a sphere about the first arm joint that contains all tcp positions."""
    origins = [np.array(joint.pos) for joint in chain.joints]
    reach = ordered_sum(float(np.linalg.norm(origin)) for origin in origins[1:])
    return tuple(float(x) for x in origins[0]), reach
