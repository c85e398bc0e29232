"""Joint modes of the arm: what its share of the action makes its seven servos do."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from mjhab.core.arrays import Array, as_like, between, namespace, to_numpy, zeros
from mjhab.core.errors import UsageError
from mjhab.robots.controllers.table import (
    ARM_JOINTS,
    ARM_NAMES,
    ActionEntry,
    ActionLimits,
    absolute_rows,
    delta_rows,
    speed_rows,
)
from mjhab.robots.fetch import model as fetch

FEED_FORWARD = fetch.ARM_GAINS.kd / fetch.ARM_GAINS.kp
"""A speed added to a position command by this factor [s] acts as the speed target of the servo:
kp (q* + v* kd/kp - q) - kd v = kp (q* - q) + kd (v* - v)."""


class Arm:
    """One way to command the arm.

    ``rows``: its dimensions of the action. ``drives``: what its servos must be. ``target`` (W, 7): joint positions
    asked for last, kept between control steps where ``remembers`` is set. ``low``, ``high`` (7,): limits of the joints.
    Arrays are of the library, device and dtype of ``like``, as the arguments of all methods must be.
    """

    remembers = False
    drives = fetch.Drives()

    def __init__(self, num_worlds: int, rows: tuple[ActionEntry, ...], like: Array) -> None:
        self.rows = rows
        self.target = zeros((num_worlds, len(ARM_JOINTS)), like)
        limits = [fetch.JOINT_LIMITS[j] for j in ARM_JOINTS]
        self.low, self.high = (as_like([pair[k] for pair in limits], like) for k in (0, 1))

    def still(self, q: Array) -> Array:
        """The action (W, len(rows)) in units that keeps the arm where it is."""
        return zeros((len(q), len(self.rows)), q)

    def reset(self, mask: Array, q: Array) -> None:
        """Targets := measured positions ``q`` (W, 7) in the worlds of ``mask`` (W,)."""
        self.target = namespace(mask).where(mask[:, None], q, self.target)

    def get_state(self, world: int) -> dict[str, np.ndarray]:
        """What `set_state` needs of one world."""
        return {"arm_target": to_numpy(self.target[world]).copy()} if self.remembers else {}

    def set_state(self, world: int, state: dict[str, np.ndarray]) -> None:
        """Put one world back into a state of `get_state`."""
        if self.remembers:
            self.target = with_row(self.target, world, state, "arm_target")


def with_row(target: Array, world: int, state: dict[str, np.ndarray], key: str) -> Array:
    """A copy of ``target`` (W, n) whose row of one world is ``state[key]``.

    Raises:
        UsageError: the state has no such key, or it has another shape.
    """
    if key not in state or np.shape(state[key]) != target.shape[1:]:
        got = {name: np.shape(value) for name, value in state.items()}
        raise UsageError(
            f"controller state needs {key!r} of shape {target.shape[1:]}, got {got}; is it of another mode?"
        )
    target = namespace(target).asarray(target, copy=True)
    target[world] = as_like(state[key], target)
    return target


class CommandedArm(Arm, ABC):
    """An arm whose commands are more than measured position + change."""

    @abstractmethod
    def command(self, move: Array, q: Array) -> Array:
        """Servo commands (W, 7) for the action ``move`` (W, len(rows)) in units, at joint positions ``q`` (W, 7)."""


class JointDelta(Arm):
    """``pd_joint_delta_pos``: measured position + change, which the controller sums together with head and torso."""

    def __init__(self, num_worlds: int, limits: ActionLimits, like: Array) -> None:
        super().__init__(
            num_worlds, delta_rows(ARM_NAMES, limits.joint_delta, "joint, from measured"), like
        )


class JointTargetDelta(CommandedArm):
    """``pd_joint_target_delta_pos``: previous target + change, kept inside the joint limits: no wind-up."""

    remembers = True

    def __init__(self, num_worlds: int, limits: ActionLimits, like: Array) -> None:
        super().__init__(
            num_worlds,
            delta_rows(ARM_NAMES, limits.joint_delta, "joint, from previous target"),
            like,
        )

    def command(self, move: Array, q: Array) -> Array:
        self.target = between(self.target + move, self.low, self.high)
        return self.target


class JointPosition(CommandedArm):
    """``pd_joint_pos``: the position itself."""

    def __init__(self, num_worlds: int, limits: ActionLimits, like: Array) -> None:
        super().__init__(num_worlds, absolute_rows(ARM_JOINTS), like)

    def command(self, move: Array, q: Array) -> Array:
        return move

    def still(self, q: Array) -> Array:
        return q


class JointVelocity(CommandedArm):
    """``pd_joint_vel``: speed servos (kp 0) that hold no position."""

    drives = fetch.Drives(velocity=ARM_NAMES)

    def __init__(self, num_worlds: int, limits: ActionLimits, like: Array) -> None:
        super().__init__(num_worlds, speed_rows(limits.joint_speed), like)

    def command(self, move: Array, q: Array) -> Array:
        return move


class JointPositionVelocity(CommandedArm):
    """``pd_joint_pos_vel``, ``pd_joint_delta_pos_vel``: seven positions or changes, then seven speeds."""

    def __init__(self, num_worlds: int, limits: ActionLimits, like: Array, *, delta: bool) -> None:
        first = (
            delta_rows(ARM_NAMES, limits.joint_delta, "joint, from measured")
            if delta
            else absolute_rows(ARM_JOINTS)
        )
        super().__init__(num_worlds, first + speed_rows(limits.joint_speed, normalized=delta), like)
        self._delta = delta

    def command(self, move: Array, q: Array) -> Array:
        count = len(ARM_JOINTS)
        wanted = q + move[:, :count] if self._delta else move[:, :count]
        return wanted + FEED_FORWARD * move[:, count:]

    def still(self, q: Array) -> Array:
        xp = namespace(q)
        speed = xp.zeros_like(q)
        return xp.concat([speed if self._delta else q, speed], axis=1)
