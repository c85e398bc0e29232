"""Arm controllers of the joint modes: from the arm's entries of an action to commands of its servos."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from mjhab.core.arrays import Array, as_like, between, namespace, to_numpy, zeros
from mjhab.core.errors import wrong_value
from mjhab.robots.controllers.table import (
    ActionEntry,
    absolute_rows,
    delta_rows,
    speed_rows,
)
from mjhab.robots.parts import ActionLimits, Drives
from mjhab.robots.robot import Robot


@dataclass(frozen=True, eq=False)
class ArmRequest:
    """Arguments of an arm controller.

    Attributes:
        robot: the robot to command.
        num_worlds: W.
        limits: ranges that actions of ±1 are scaled to.
        like: an array of the library, device and dtype of the simulator's joint positions.
    """

    robot: Robot
    num_worlds: int
    limits: ActionLimits
    like: Array


class ArmController:
    """Base class of arm controllers, for an arm of A joints in W worlds.

    Its arrays, and the arguments of its methods, have the library, device and dtype of ``request.like``.

    Attributes:
        remembers: the next command depends on ``target``, which is then part of the controller's state.
        absolute: actions are joint positions.
        rows: entries of the action that command the arm.
        drives: servos that the arm needs.
        target: (W, A) last commanded joint positions [rad].
        low: (A,) lower joint limits [rad].
        high: (A,) upper joint limits [rad].
    """

    remembers = False
    absolute = False

    def __init__(self, request: ArmRequest, rows: tuple[ActionEntry, ...]) -> None:
        robot = request.robot
        like = request.like
        self.rows = rows
        self.drives = Drives()
        self.target = zeros((request.num_worlds, len(robot.arm_columns)), like)
        limits = [robot.joint_limits[j] for j in robot.arm_columns]
        self.low, self.high = (
            as_like([pair[k] for pair in limits], like) for k in (0, 1)
        )

    def still(self, q: Array) -> Array:
        """Return the action (W, len(rows)) in physical units that holds the arm at positions ``q`` (W, A) [rad]."""
        return zeros((len(q), len(self.rows)), q)

    def reset(self, mask: Array, q: Array) -> None:
        """Set the targets of the worlds of ``mask`` (W,) bool to the measured positions ``q`` (W, A) [rad]."""
        # A new array: that of the last step may still be held by whoever recorded it.
        self.target = namespace(mask).where(mask[:, None], q, self.target)

    def get_state(self, world: int) -> dict[str, np.ndarray]:
        """Return the controller state of one world for `set_state`; {} if it has none."""
        return (
            {"arm_target": to_numpy(self.target[world]).copy()} if self.remembers else {}
        )

    def set_state(self, world: int, state: dict[str, np.ndarray]) -> None:
        """Restore the controller state of one world from `get_state`."""
        if self.remembers:
            self.target = with_row(self.target, world, state, "arm_target")


def with_row(target: Array, world: int, state: dict[str, np.ndarray], key: str) -> Array:
    """Return a copy of ``target`` (W, n) with row ``world`` replaced by ``state[key]``.

    Raises:
        UsageError: the state lacks the key, or its array has another shape.
    """
    # A state of another mode would be spread over the row, or have no key.
    if key not in state or np.shape(state[key]) != target.shape[1:]:
        got = {name: np.shape(value) for name, value in state.items()}
        raise wrong_value(
            "controller state",
            got,
            f"{key!r} of shape {target.shape[1:]}",
            "Is it of another mode?",
        )
    target = namespace(target).asarray(target, copy=True)
    target[world] = as_like(state[key], target)
    return target


class CommandedArm(ArmController, ABC):
    """An arm controller that computes its own commands, unlike `JointDelta`."""

    @abstractmethod
    def command(self, move: Array, q: Array) -> Array:
        """Compute the servo commands (W, A) [rad, or rad/s for velocity servos].

        Args:
            move: (W, len(rows)) action in physical units.
            q: (W, A) measured joint positions [rad].
        """


class JointDelta(ArmController):
    """``pd_joint_delta_pos``: measured position + change, which `Controller` adds together with head and torso."""

    def __init__(self, request: ArmRequest) -> None:
        super().__init__(request, _delta_rows(request, "joint, from measured"))


class JointTargetDelta(CommandedArm):
    """``pd_joint_target_delta_pos``: previous target + change, clipped to the joint limits against wind-up."""

    remembers = True

    def __init__(self, request: ArmRequest) -> None:
        super().__init__(request, _delta_rows(request, "joint, from previous target"))

    def command(self, move: Array, q: Array) -> Array:
        # Without the clip the target runs away while the arm is at its limit, and the way back takes as long.
        self.target = between(self.target + move, self.low, self.high)
        return self.target


class JointPosition(CommandedArm):
    """``pd_joint_pos``: absolute joint positions."""

    absolute = True

    def __init__(self, request: ArmRequest) -> None:
        super().__init__(
            request, absolute_rows(request.robot, request.robot.group("arm"))
        )

    def command(self, move: Array, q: Array) -> Array:
        return move

    def still(self, q: Array) -> Array:
        return q


class JointVelocity(CommandedArm):
    """``pd_joint_vel``: joint speeds, with velocity servos (kp 0) that hold no position."""

    def __init__(self, request: ArmRequest) -> None:
        super().__init__(request, speed_rows(request.robot, request.limits))
        self.drives = Drives(velocity=request.robot.group("arm"))

    def command(self, move: Array, q: Array) -> Array:
        return move


class JointPositionVelocity(CommandedArm):
    """``pd_joint_pos_vel``, ``pd_joint_delta_pos_vel``: positions or changes of all A joints, then their A speeds."""

    def __init__(self, request: ArmRequest, *, delta: bool) -> None:
        robot = request.robot
        first = (
            _delta_rows(request, "joint, from measured")
            if delta
            else absolute_rows(robot, robot.group("arm"))
        )
        super().__init__(
            request, first + speed_rows(robot, request.limits, normalized=delta)
        )
        self._delta = delta
        self.absolute = not delta
        self._count = len(robot.arm_columns)
        # A speed added to a position command by this factor [s] acts as the speed target of the servo:
        # kp (q* + v* kd/kp - q) - kd v = kp (q* - q) + kd (v* - v).
        self._feed_forward = robot.gains["arm"].kd / robot.gains["arm"].kp

    def command(self, move: Array, q: Array) -> Array:
        count = self._count
        wanted = q + move[:, :count] if self._delta else move[:, :count]
        return wanted + self._feed_forward * move[:, count:]

    def still(self, q: Array) -> Array:
        xp = namespace(q)
        speed = xp.zeros_like(q)
        return xp.concat([speed if self._delta else q, speed], axis=1)


def _delta_rows(request: ArmRequest, frame: str) -> tuple[ActionEntry, ...]:
    """Return the entries of the arm joints for changes of up to ``joint_delta`` [rad] per control step."""
    robot = request.robot
    return delta_rows(robot, robot.group("arm"), request.limits.joint_delta, frame)
