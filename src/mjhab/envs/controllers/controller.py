"""From actions to actuator commands: the arm by mode, and gripper, body and base, which all modes share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjhab.core.errors import UsageError, unknown_name
from mjhab.envs.controllers.arm import Arm, with_row
from mjhab.envs.controllers.table import (
    ARM_JOINTS,
    BODY_JOINTS,
    BODY_NAMES,
    FINGER_JOINTS,
    ActionEntry,
    ActionLimits,
    absolute_rows,
    base_rows,
    delta_rows,
    gripper_row,
)
from mjhab.scenes import fetch
from mjhab.sim.protocol import SimState

BASES = ("forward", "holonomic")
STATIONARY = ("head", "torso", "base")


class Controller:
    """Turns actions (W, dim) into actuator commands held for the control step. Build it with `make_controller`.

    Attributes:
        mode: its name.
        dim: numbers in an action.
        table: one `ActionEntry` per number, in order.
        low, high: (dim,) float32 bounds of the action space: ±1, or the bounds in units where a row is not normalized.
            Actions outside are clipped.
        drives: the servos the simulator must have.
        gripper: index of the gripper's number.
    """

    def __init__(
        self, mode: str, arm: Arm, limits: ActionLimits, *, stiff_body: bool, base: str, stationary: Sequence[str]
    ) -> None:
        _check_options(base, stationary)
        self.mode, self.limits = mode, limits
        self._arm, self._stiff_body, self._holonomic = arm, stiff_body, base == "holonomic"
        body = absolute_rows(BODY_JOINTS) if stiff_body else delta_rows(BODY_NAMES, limits.joint_delta, _MEASURED)
        self.table: tuple[ActionEntry, ...] = (
            *arm.rows, gripper_row(limits), *body, *base_rows(limits, self._holonomic)
        )  # fmt: skip
        self.dim, self.gripper = len(self.table), len(arm.rows)
        self.low = np.array([-1.0 if row.normalized else row.low for row in self.table], np.float32)
        self.high = np.array([1.0 if row.normalized else row.high for row in self.table], np.float32)
        self.drives = fetch.Drives(arm.drives.velocity, BODY_NAMES if stiff_body else ())
        self._place_columns(stationary)
        self._body_target = np.zeros((len(arm.target), len(BODY_JOINTS)))

    def _place_columns(self, stationary: Sequence[str]) -> None:
        """Where each part sits in the action and in the commands, whose columns are in FETCH_JOINTS order."""
        start = self.gripper + 1
        self._body = slice(start, start + len(BODY_JOINTS))
        self._base = self._body.stop
        parts = {"head": (start, start + 1), "torso": (start + 2,), "base": range(self._base, self.dim)}
        self._zeroed = [column for part in stationary for column in parts[part]]
        self._held_body = np.array([start + i in self._zeroed for i in range(len(BODY_JOINTS))])
        # Everything that moves from its measured position is one sum: in the default mode arm, head and torso.
        moved = dict(zip(ARM_JOINTS, range(self.gripper), strict=True)) if self._arm.from_measured else {}
        if not self._stiff_body:
            moved |= dict(zip(BODY_JOINTS, range(start, self._base), strict=True))
        self._moved, self._deltas = np.array(list(moved), np.intp), np.array(list(moved.values()), np.intp)
        self._arm_units = np.array([row.high if row.normalized else 1.0 for row in self._arm.rows])

    def ctrl(self, actions: np.ndarray, state: SimState) -> np.ndarray:
        """Actuator commands (W, nu) for actions (W, dim) in the present state; targets of the target modes move on."""
        return self.command(actions, state.robot_q)

    def command(self, actions: np.ndarray, robot_q: np.ndarray) -> np.ndarray:
        """`ctrl` at joint positions (W, 15), which are all it needs of the state."""
        a = np.minimum(np.maximum(actions, self.low), self.high, dtype=np.float64)
        if self._zeroed:
            a[:, self._zeroed] = 0.0
        out = np.empty((len(a), len(fetch.ACTUATORS)))
        out[:, self._moved] = robot_q[:, self._moved] + self.limits.joint_delta * a[:, self._deltas]
        if not self._arm.from_measured:
            out[:, _ARM] = self._arm.command(a[:, : self.gripper] * self._arm_units, robot_q[:, _ARM])
        if self._stiff_body:
            out[:, _BODY] = np.where(self._held_body, self._body_target, a[:, self._body])
        low, high = self.limits.gripper
        out[:, _FINGERS] = low + 0.5 * (a[:, self.gripper : self.gripper + 1] + 1.0) * (high - low)
        self._drive(out, a, robot_q[:, 2])
        return out

    def _drive(self, out: np.ndarray, a: np.ndarray, yaw: np.ndarray) -> None:
        speed, cos, sin = self.limits.forward * a[:, self._base], np.cos(yaw), np.sin(yaw)
        out[:, 0] = speed * cos
        out[:, 1] = speed * sin
        if self._holonomic:
            left = self.limits.forward * a[:, self._base + 1]
            out[:, 0] -= left * sin
            out[:, 1] += left * cos
        out[:, 2] = self.limits.yaw_rate * a[:, -1]

    def still(self, state: SimState) -> np.ndarray:
        """Actions (W, dim) float32 that keep the robot where it is; the gripper's number is 0 (fingers at 2 cm)."""
        actions = np.zeros((len(state.robot_q), self.dim), np.float32)
        actions[:, : self.gripper] = self._arm.still(state.robot_q[:, _ARM]) / self._arm_units
        if self._stiff_body:
            actions[:, self._body] = state.robot_q[:, _BODY]
        return actions

    def reset(self, mask: np.ndarray, state: SimState) -> None:
        """Previous targets := measured positions in the worlds of ``mask`` (W,) bool, after they were put elsewhere."""
        self._arm.reset(mask, state.robot_q[:, _ARM])
        self._body_target = np.where(mask[:, None], state.robot_q[:, _BODY], self._body_target)

    def get_state(self, world: int) -> dict[str, np.ndarray]:
        """What the next command of one world depends on besides action and state; {} where that is nothing."""
        body = {"body_target": self._body_target[world].copy()} if self._stiff_body else {}
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
_ARM, _BODY, _FINGERS = np.array(ARM_JOINTS), np.array(BODY_JOINTS), np.array(FINGER_JOINTS)


def _check_options(base: str, stationary: Sequence[str]) -> None:
    if base not in BASES:
        raise unknown_name("base control", base, BASES)
    if isinstance(stationary, str):
        raise UsageError(f"stationary must be a tuple of parts, got the text {stationary!r}; write ({stationary!r},)")
    for part in stationary:
        if part not in STATIONARY:
            raise unknown_name("stationary part", part, STATIONARY)
