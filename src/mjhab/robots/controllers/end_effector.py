"""End effector modes: gripper poses in the frame of the arm's root become arm joints by damped least squares."""

from __future__ import annotations

from typing import Literal

import numpy as np

from mjhab.core.arrays import Array, between, constant, namespace, zeros
from mjhab.robots.controllers.arm import ArmRequest, CommandedArm
from mjhab.robots.controllers.table import ActionEntry
from mjhab.robots.kinematics import Chain, StepBounds, limited_step, rotate, rotation_vector

Start = Literal["measured", "target", "absolute"]
"""What a command counts from: the measured pose, the previous target, or the frame of the torso."""

ITERATIONS = 3
"""Steps of damped least squares per control step. Motions of centimetres are then met within micrometres; of the
largest commands (0.1 m along each axis and 0.1 rad) from random postures half are met within 0.4 mm and 4 mrad. A
farther absolute goal is approached over several control steps."""
LARGEST_STEP = 0.2
"""Bound [rad] on the change of a joint in one of these steps: no jumps near singular postures."""
LEVER = 0.03
"""Weight of orientation against position [m/rad]: where joint limits allow only one of them, position comes first."""
DAMPING = 1e-5
"""Small enough that no error is left, large enough for smooth motion along joint limits; far from the goal
`limited_step` adds more."""
_AXES = ("x", "y", "z")
_WEIGHTS = (1.0, 1.0, 1.0, LEVER, LEVER, LEVER)


class EndEffector(CommandedArm):
    """Changes along fixed or own axes, or absolute poses. Orientations are rotation vectors.

    ``rotates`` False: three numbers, and the orientation goes wherever the smallest joint motion takes it, as the
    position-only inverse kinematics of the original. ``own_axes``: the change is along and about the axes of the
    gripper (``pd_ee_delta_pose_align``; the original names a frame "ee_align" that its controllers no longer define).
    The target is what the arm can reach: it does not wind up beyond the workspace.
    """

    def __init__(
        self,
        request: ArmRequest,
        *,
        start: Start,
        rotates: bool = True,
        own_axes: bool = False,
    ) -> None:
        super().__init__(request, _rows(request, start, rotates, own_axes))
        self.remembers = start != "measured"
        self._start = start
        self._rotates = rotates
        self._own_axes = own_axes
        self._turn = request.limits.ee_turn
        self._chain = request.robot.arm_chain

    def command(self, move: Array, q: Array) -> Array:
        begin = between(self.target if self.remembers else q, self.low, self.high)
        self.target = self._solve(*self._goal(move, begin), begin)
        return self.target

    def still(self, q: Array) -> Array:
        if self._start != "absolute":
            return super().still(q)
        pos, rot = self._chain.tip_pose(self.target)
        return namespace(pos).concat([pos, rotation_vector(rot)], axis=1)

    def _goal(self, move: Array, begin: Array) -> tuple[Array, Array]:
        """Goal position (W, 3) and rotation (W, 3, 3) in the frame of the torso."""
        if self._start == "absolute":
            return move[:, :3], rotate(move[:, 3:])
        pos, rot = self._chain.tip_pose(begin)
        if not self._rotates:
            return pos + move, rot
        xp = namespace(move)
        length = xp.sqrt(xp.sum(move[:, 3:] ** 2, axis=1, keepdims=True))
        turn = rotate(
            move[:, 3:] * (self._turn / xp.maximum(length, constant((self._turn,), length)))
        )
        if self._own_axes:
            return pos + (rot @ move[:, :3, None])[..., 0], rot @ turn
        return pos + move[:, :3], turn @ rot

    def _solve(self, pos: Array, rot: Array, q: Array) -> Array:
        xp = namespace(q)
        rows = 6 if self._rotates else 3
        for _ in range(ITERATIONS):
            frames = self._chain.forward(q)
            jac = self._chain.jacobian(q, frames)[:, :rows]
            error = pos - frames.pos[:, self._chain.tip_index]
            if self._rotates:
                spin = rotation_vector(rot @ frames.rot[:, self._chain.tip_index].swapaxes(1, 2))
                error = xp.concat([error, LEVER * spin], axis=1)
                jac = jac * constant(_WEIGHTS, jac)[:, None]
            bounds = StepBounds(self.low - q, self.high - q, LARGEST_STEP)
            step = limited_step(error, jac, zeros(q.shape, q), bounds, DAMPING)
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
                f"ee_{axis}", link, c - reach, c + reach, "m", f"{root}, absolute", normalized=False
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
    """Centre (3,) and radius [m] of the sphere about the shoulder that holds everything in reach."""
    origins = [np.array(joint.pos) for joint in chain.joints]
    return tuple(float(x) for x in origins[0]), float(
        sum(np.linalg.norm(origin) for origin in origins[1:])
    )
