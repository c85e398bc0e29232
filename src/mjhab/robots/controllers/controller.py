"""From actions to actuator commands: the arm by mode, and gripper, body and base, which all modes share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from mjhab.core.arrays import Array, as_like, device_of, empty, namespace, to_numpy, zeros
from mjhab.core.errors import UsageError, unknown_name
from mjhab.robots.controllers.arm import Arm, CommandedArm, with_row
from mjhab.robots.controllers.table import (
    ActionEntry,
    absolute_rows,
    base_rows,
    delta_rows,
    gripper_row,
)
from mjhab.robots.parts import ActionLimits, Drives
from mjhab.robots.robot import Robot

BASES = ("forward", "holonomic")
STATIONARY = ("head", "torso", "base")


class JointState(Protocol):
    """What a controller reads of the state of a simulation."""

    @property
    def robot_q(self) -> Array:
        """(W, J) joint positions [m, rad]."""
        ...


class Controller:
    """Turns actions (W, dim) into actuator commands held for the control step. Build it with `make_controller`.

    Attributes:
        mode: its name.
        robot: the robot it commands.
        dim: numbers in an action.
        table: one `ActionEntry` per number, in order.
        low, high: (dim,) float32 bounds of the action space: ±1, or the bounds in units where a row is not normalized.
            Actions outside are clipped.
        drives: the servos the simulator must have.
        gripper: index of the gripper's number.
    """

    def __init__(
        self,
        mode: str,
        robot: Robot,
        arm: Arm,
        limits: ActionLimits,
        *,
        stiff_body: bool,
        base: str,
        stationary: Sequence[str],
    ) -> None:
        _check_options(base, stationary)
        self.mode = mode
        self.robot = robot
        self.limits = limits
        self._arm = arm
        self._stiff_body = stiff_body
        self._holonomic = base == "holonomic"
        body = (
            absolute_rows(robot, robot.body_joints)
            if stiff_body
            else delta_rows(robot, robot.body_joints, limits.joint_delta, _MEASURED)
        )
        self.table: tuple[ActionEntry, ...] = (
            *arm.rows,
            gripper_row(robot, limits),
            *body,
            *base_rows(robot, limits, self._holonomic),
        )
        self.dim = len(self.table)
        self.gripper = len(arm.rows)
        self.low = np.array([-1.0 if row.normalized else row.low for row in self.table], np.float32)
        self.high = np.array(
            [1.0 if row.normalized else row.high for row in self.table], np.float32
        )
        self.drives = Drives(arm.drives.velocity, robot.body_joints if stiff_body else ())
        self._place_columns(stationary)
        self._keep_arrays(arm.target)

    def _place_columns(self, stationary: Sequence[str]) -> None:
        """Where each part sits in the action and in the commands, whose columns are those of the joints."""
        start = self.gripper + 1
        torso = start + len(self.robot.head_columns)
        self._body = slice(start, start + len(self.robot.body_columns))
        self._base = self._body.stop
        parts = {
            "head": range(start, torso),
            "torso": range(torso, self._base),
            "base": range(self._base, self.dim),
        }
        self._zeroed = [column for part in stationary for column in parts[part]]

    def _keep_arrays(self, like: Array) -> None:
        """What the commands are made with, on the device of ``like``."""
        start = self.gripper + 1
        whole = namespace(like).int64
        # Everything that moves from its measured position is one sum: in the default mode arm, head and torso.
        sums = not isinstance(self._arm, CommandedArm)
        robot = self.robot
        moved = dict(zip(robot.arm_columns, range(self.gripper), strict=True)) if sums else {}
        if not self._stiff_body:
            moved |= dict(zip(robot.body_columns, range(start, self._base), strict=True))
        self._moved = as_like(list(moved), like, whole)
        self._deltas = as_like(list(moved.values()), like, whole)
        parts = (robot.arm_columns, robot.body_columns, robot.finger_columns)
        self._arm_columns, self._body_columns, self._finger_columns = (
            as_like(p, like, whole) for p in parts
        )
        self._arm_units = as_like(
            [row.high if row.normalized else 1.0 for row in self._arm.rows], like
        )
        # The bounds are those of float32 actions, to the bit.
        self._low = as_like(self.low, like)
        self._high = as_like(self.high, like)
        free = as_like(
            [column not in self._zeroed for column in range(self.dim)], like, namespace(like).bool
        )
        self._free = free
        self._held_body = ~free[self._body]
        self._body_target = zeros((len(like), len(robot.body_columns)), like)

    def ctrl(self, actions: Array, state: JointState) -> Array:
        """Actuator commands (W, nu) for actions (W, dim) in the present state; targets of the target modes move on."""
        return self.command(actions, state.robot_q)

    def command(self, actions: Array, robot_q: Array) -> Array:
        """`ctrl` at joint positions (W, J), which are all it needs of the state."""
        xp = namespace(actions)
        a = xp.minimum(xp.maximum(actions, self._low), self._high)
        if self._zeroed:
            a = xp.where(self._free, a, 0.0)
        out = empty((len(a), len(self.robot.joints)), robot_q)
        out[:, self._moved] = robot_q[:, self._moved] + self.limits.joint_delta * a[:, self._deltas]
        if isinstance(self._arm, CommandedArm):
            arm_q = robot_q[:, self._arm_columns]
            out[:, self._arm_columns] = self._arm.command(
                a[:, : self.gripper] * self._arm_units, arm_q
            )
        if self._stiff_body:
            out[:, self._body_columns] = xp.where(
                self._held_body, self._body_target, a[:, self._body]
            )
        low, high = self.limits.gripper
        out[:, self._finger_columns] = low + 0.5 * (a[:, self.gripper : self.gripper + 1] + 1.0) * (
            high - low
        )
        self._drive(out, a, robot_q[:, 2])
        return out

    def _drive(self, out: Array, a: Array, yaw: Array) -> None:
        xp = namespace(yaw)
        speed = self.limits.forward * a[:, self._base]
        cos = xp.cos(yaw)
        sin = xp.sin(yaw)
        out[:, 0] = speed * cos
        out[:, 1] = speed * sin
        if self._holonomic:
            left = self.limits.forward * a[:, self._base + 1]
            out[:, 0] -= left * sin
            out[:, 1] += left * cos
        out[:, 2] = self.limits.yaw_rate * a[:, -1]

    def still(self, state: JointState) -> Array:
        """Actions (W, dim) float32 that keep the robot where it is; the gripper's number is 0 (fingers at 2 cm)."""
        xp = namespace(state.robot_q)
        q = state.robot_q
        actions = xp.zeros((len(q), self.dim), dtype=xp.float32, device=device_of(q))
        actions[:, : self.gripper] = self._arm.still(q[:, self._arm_columns]) / self._arm_units
        if self._stiff_body:
            actions[:, self._body] = q[:, self._body_columns]
        return actions

    def reset(self, mask: Array, state: JointState) -> None:
        """Previous targets := measured positions in the worlds of ``mask`` (W,) bool, after they were put elsewhere."""
        q = state.robot_q
        self._arm.reset(mask, q[:, self._arm_columns])
        self._body_target = namespace(q).where(
            mask[:, None], q[:, self._body_columns], self._body_target
        )

    def get_state(self, world: int) -> dict[str, np.ndarray]:
        """What the next command of one world depends on besides action and state; {} where that is nothing."""
        body = (
            {"body_target": to_numpy(self._body_target[world]).copy()} if self._stiff_body else {}
        )
        return self._arm.get_state(world) | body

    def set_state(self, world: int, state: dict[str, np.ndarray]) -> None:
        """Put one world back into a state of `get_state`.

        Raises:
            UsageError: the state is that of another mode.
        """
        self._arm.set_state(world, state)
        if self._stiff_body:
            self._body_target = with_row(self._body_target, world, state, "body_target")


_MEASURED = "joint, from measured"


def _check_options(base: str, stationary: Sequence[str]) -> None:
    if base not in BASES:
        raise unknown_name("base control", base, BASES)
    if isinstance(stationary, str):
        raise UsageError(
            f"stationary must be a tuple of parts, got the text {stationary!r}; write ({stationary!r},)"
        )
    for part in stationary:
        if part not in STATIONARY:
            raise unknown_name("stationary part", part, STATIONARY)
