"""From actions to actuator commands: the arm depends on the mode; gripper, body and base are common to all modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mjhab.core.arrays import Array, as_like, device_of, empty, namespace, to_numpy, zeros
from mjhab.core.conventions.changes import nearest_turn, within_half_a_turn
from mjhab.core.errors import unknown_name, wrong_value
from mjhab.robots.controllers.arm import ArmController, CommandedArm, with_row
from mjhab.robots.controllers.table import (
    ActionEntry,
    absolute_rows,
    base_rows,
    delta_rows,
    gripper_row,
)
from mjhab.robots.parts import Drives
from mjhab.robots.robot import Robot

BASES = ("forward", "holonomic")
STATIONARY = ("head", "torso", "base")


class JointState(Protocol):
    """The part of `SimState` that a controller reads."""

    @property
    def robot_q(self) -> Array:
        """(W, J) joint positions [m, rad]."""
        ...


@dataclass(frozen=True)
class BodyOptions:
    """How torso, head and base are commanded.

    Attributes:
        stiff: torso and head take absolute positions [rad, m] with stiff servos, instead of changes.
        base: one of BASES.
        stationary: parts of STATIONARY whose entries of an action are taken as zero.

    Raises:
        UsageError: there is no such base control or part.
    """

    stiff: bool = False
    base: str = "forward"
    stationary: Sequence[str] = ()

    def __post_init__(self) -> None:
        _check_options(self.base, self.stationary)


class Controller:
    """Turns actions (W, dim) into actuator commands that hold for a control step. Build it with `make_controller`.

    Attributes:
        mode: name of the control mode.
        robot: the robot it commands.
        limits: ranges that actions of ±1 are scaled to.
        dim: size of an action.
        table: (dim,) entries of the action.
        low: (dim,) float32 lower bounds of the action space: -1, or in physical units for entries that are not
            normalized. Actions are clipped to the bounds.
        high: (dim,) float32 upper bounds.
        drives: servos that the simulator must have.
        gripper: column of the gripper in an action.
        shortest: whether positions that are commanded to joints of the arm without limits are reached by the shortest
            turn; False: by turning back every turn that they have made, as the original does.
    """

    def __init__(
        self,
        mode: str,
        robot: Robot,
        arm: ArmController,
        options: BodyOptions,
    ) -> None:
        stiff_body = options.stiff
        limits = robot.limits
        self.mode = mode
        self.robot = robot
        self.limits = limits
        self._arm = arm
        self._stiff_body = stiff_body
        self._holonomic = options.base == "holonomic"
        self.shortest = False
        self._endless = tuple(robot.endless[column] for column in robot.arm_columns)
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
        self.low = np.array(
            [-1.0 if row.normalized else row.low for row in self.table], np.float32
        )
        self.high = np.array(
            [1.0 if row.normalized else row.high for row in self.table], np.float32
        )
        self.drives = Drives(arm.drives.velocity, robot.body_joints if stiff_body else ())
        self._place_columns(options.stationary)
        self._keep_arrays(arm.target)

    def _place_columns(self, stationary: Sequence[str]) -> None:
        """Set the columns of each part in actions, and those that are stationary."""
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

    @property
    def base_columns(self) -> range:
        """Columns of the base in actions."""
        return range(self._base, self.dim)

    def _keep_arrays(self, like: Array) -> None:
        """Make the index arrays, units and bounds that `command` uses, on the device of ``like``."""
        start = self.gripper + 1
        whole = namespace(like).int64
        # All joints commanded as measured position + change are computed in one sum: by default arm, head and torso.
        sums = not isinstance(self._arm, CommandedArm)
        robot = self.robot
        # Modes with commands of their own set the arm's columns afterwards.
        moved = (
            dict(zip(robot.arm_columns, range(self.gripper), strict=True)) if sums else {}
        )
        if not self._stiff_body:
            moved |= dict(zip(robot.body_columns, range(start, self._base), strict=True))
        # Index arrays once: on a device every list of columns would be a transfer.
        self._moved = as_like(list(moved), like, whole)
        self._deltas = as_like(list(moved.values()), like, whole)
        parts = (robot.arm_columns, robot.body_columns, robot.finger_columns)
        self._arm_columns, self._body_columns, self._finger_columns = (
            as_like(p, like, whole) for p in parts
        )
        self._arm_units = as_like(
            [row.high if row.normalized else 1.0 for row in self._arm.rows], like
        )
        # The float32 bounds, so that clipping gives the same result for any dtype of ``like``.
        self._low = as_like(self.low, like)
        self._high = as_like(self.high, like)
        free = as_like(
            [column not in self._zeroed for column in range(self.dim)],
            like,
            namespace(like).bool,
        )
        self._free = free
        # An absolute target of 0 would not be "stay", so that stationary joints keep where they were.
        self._held_body = ~free[self._body]
        self._body_target = zeros((len(like), len(robot.body_columns)), like)

    def ctrl(self, actions: Array, state: JointState) -> Array:
        """Compute the actuator commands (W, nu) for actions (W, dim) in the present state.

        Updates the targets of the target modes: call it once per control step.
        """
        return self.command(actions, state.robot_q)

    def command(self, actions: Array, robot_q: Array) -> Array:
        """Compute `ctrl` from measured joint positions ``robot_q`` (W, J) [m, rad] instead of a state."""
        xp = namespace(actions)
        a = xp.minimum(xp.maximum(actions, self._low), self._high)
        if self._zeroed:
            # Zero is "stay" for changes and speeds; where entries are absolute, `_body_target` holds instead.
            a = xp.where(self._free, a, 0.0)
        # All columns are written below.
        out = empty((len(a), len(self.robot.joints)), robot_q)
        out[:, self._moved] = (
            robot_q[:, self._moved] + self.limits.joint_delta * a[:, self._deltas]
        )
        if isinstance(self._arm, CommandedArm):
            arm_q = robot_q[:, self._arm_columns]
            aim = self._arm.command(a[:, : self.gripper] * self._arm_units, arm_q)
            if self.shortest and self._arm.absolute:
                # Absolute angles are told within half a turn: without this a wrist would unwind whole turns.
                aim = nearest_turn(aim, arm_q, self._endless)
            out[:, self._arm_columns] = aim
        if self._stiff_body:
            out[:, self._body_columns] = xp.where(
                self._held_body, self._body_target, a[:, self._body]
            )
        low, high = self.limits.gripper
        out[:, self._finger_columns] = low + 0.5 * (
            a[:, self.gripper : self.gripper + 1] + 1.0
        ) * (high - low)
        self._drive(out, a, robot_q[:, 2])
        return out

    def _drive(self, out: Array, a: Array, yaw: Array) -> None:
        xp = namespace(yaw)
        speed = self.limits.forward * a[:, self._base]
        # The heading at the start of the control step holds for all of it, as in ManiSkill.
        cos = xp.cos(yaw)
        sin = xp.sin(yaw)
        out[:, 0] = speed * cos
        out[:, 1] = speed * sin
        if self._holonomic:
            left = self.limits.forward * a[:, self._base + 1]
            out[:, 0] -= left * sin
            out[:, 1] += left * cos
        out[:, 2] = self.limits.yaw_rate * a[:, -1]

    def still(self, state: JointState, grip: Array | float = 0.0) -> Array:
        """Return actions (W, dim) float32 that hold the robot's pose.

        ``grip``: entries (W,) of the gripper. By 0 the fingers go to the middle of `ActionLimits.gripper`, and drop
        what they hold.
        """
        xp = namespace(state.robot_q)
        q = state.robot_q
        actions = xp.zeros((len(q), self.dim), dtype=xp.float32, device=device_of(q))
        arm_q = q[:, self._arm_columns]
        if self.shortest and self._arm.absolute:
            arm_q = within_half_a_turn(arm_q, self._endless)
        # In units of actions, as `command` multiplies by them.
        actions[:, : self.gripper] = self._arm.still(arm_q) / self._arm_units
        if self._stiff_body:
            actions[:, self._body] = q[:, self._body_columns]
        actions[:, self.gripper] = grip
        return actions

    def present_grip(self, state: JointState) -> Array:
        """Return the gripper entries (W,) float32 of actions that leave the fingers where they are."""
        xp = namespace(state.robot_q)
        opening = state.robot_q[:, self._finger_columns].sum(-1)
        return xp.astype(self.limits.gripper_entry(opening), xp.float32)

    def reset(self, mask: Array, state: JointState) -> None:
        """Set the targets of the worlds of ``mask`` (W,) bool to the measured positions, after a reset or teleport."""
        q = state.robot_q
        self._arm.reset(mask, q[:, self._arm_columns])
        self._body_target = namespace(q).where(
            mask[:, None], q[:, self._body_columns], self._body_target
        )

    def get_state(self, world: int) -> dict[str, np.ndarray]:
        """Return the controller state of one world for `set_state`; {} for modes without state."""
        body = (
            {"body_target": to_numpy(self._body_target[world]).copy()}
            if self._stiff_body
            else {}
        )
        return self._arm.get_state(world) | body

    def set_state(self, world: int, state: dict[str, np.ndarray]) -> None:
        """Restore the controller state of one world from `get_state`.

        Raises:
            UsageError: the state is that of another control mode.
        """
        self._arm.set_state(world, state)
        if self._stiff_body:
            self._body_target = with_row(self._body_target, world, state, "body_target")


_MEASURED = "joint, from measured"


def _check_options(base: str, stationary: Sequence[str]) -> None:
    if base not in BASES:
        raise unknown_name("base control", base, BASES)
    if isinstance(stationary, str):
        raise wrong_value(
            "stationary", stationary, "a tuple of parts", f"Write ({stationary!r},)."
        )
    for part in stationary:
        if part not in STATIONARY:
            raise unknown_name("stationary part", part, STATIONARY)
