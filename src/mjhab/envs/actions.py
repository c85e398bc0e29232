"""The 13-D action and its controller ``pd_joint_delta_pos`` (mani_skill/agents/robots/fetch/fetch.py)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.scenes import fetch

ARM = slice(0, 7)
GRIPPER, HEAD_PAN, HEAD_TILT, TORSO, BASE_FORWARD, BASE_YAW = 7, 8, 9, 10, 11, 12
ACTION_DIM = 13
ARM_JOINTS = (5, 7, 8, 9, 10, 11, 12)
"""Indices in FETCH_JOINTS of the seven arm joints, in action order."""


@dataclass(frozen=True)
class ActionLimits:
    """What an action of ±1 means."""

    joint_delta: float = 0.1
    """Arm, head [rad] and torso [m] change per control step, from the measured position."""
    gripper: tuple[float, float] = (-0.01, 0.05)
    """Finger position [m] at -1 and +1; below zero squeezes."""
    forward: float = 1.0
    """Base speed [m/s]."""
    yaw_rate: float = 3.14
    """Base turning speed [rad/s]."""


@dataclass(frozen=True)
class ActionEntry:
    """One dimension of the action: ``low``/``high`` in ``unit`` at -1/+1."""

    name: str
    joint: str
    low: float
    high: float
    unit: str
    frame: str


def action_table(limits: ActionLimits | None = None) -> tuple[ActionEntry, ...]:
    """Name, meaning and bounds of every action dimension, in order."""
    limits = limits or ActionLimits()
    d = limits.joint_delta
    arm = [fetch.FETCH_JOINTS[j] for j in ARM_JOINTS]
    rows = [ActionEntry(joint, joint, -d, d, "rad", "joint, from measured") for joint in arm]
    rows.append(ActionEntry("gripper", "l_gripper_finger_joint", *limits.gripper, "m", "joint, absolute, both fingers"))
    for joint in ("head_pan_joint", "head_tilt_joint", "torso_lift_joint"):
        rows.append(ActionEntry(joint, joint, -d, d, "m" if "torso" in joint else "rad", "joint, from measured"))
    rows.append(ActionEntry("base_forward", "root_x_axis_joint", -limits.forward, limits.forward, "m/s", "base +x"))
    rows.append(ActionEntry("base_yaw", "root_z_rotation_joint", -limits.yaw_rate, limits.yaw_rate, "rad/s", "base +z"))
    return tuple(rows)


class JointDeltaController:
    """Turns actions into actuator commands: targets = measured position + delta, held for the control step."""

    def __init__(self, limits: ActionLimits | None = None) -> None:
        self.limits = limits or ActionLimits()
        column = {name: i for i, name in enumerate(fetch.ACTUATORS)}
        joints = fetch.FETCH_JOINTS
        moved = dict(zip(ARM_JOINTS, range(ARM.start, ARM.stop), strict=True))
        body = (("head_pan_joint", HEAD_PAN), ("head_tilt_joint", HEAD_TILT), ("torso_lift_joint", TORSO))
        moved |= {joints.index(name): action for name, action in body}
        self._joints = np.array(list(moved))
        self._deltas = np.array(list(moved.values()))
        self._moved = np.array([column[joints[j]] for j in moved])
        self._fingers = np.array([column[n] for n in ("r_gripper_finger_joint", "l_gripper_finger_joint")])
        self._base = [column[n] for n in ("root_x_axis_joint", "root_y_axis_joint", "root_z_rotation_joint")]
        self.num_actuators = len(fetch.ACTUATORS)

    def ctrl(self, actions: np.ndarray, robot_q: np.ndarray) -> np.ndarray:
        """Actuator commands (W, nu) for actions (W, 13), clipped to [-1, 1], at joint positions (W, 15)."""
        a = np.minimum(np.maximum(actions, -1.0), 1.0, dtype=np.float64)
        out = np.empty((len(a), self.num_actuators))
        out[:, self._moved] = robot_q[:, self._joints] + self.limits.joint_delta * a[:, self._deltas]
        low, high = self.limits.gripper
        out[:, self._fingers] = low + 0.5 * (a[:, GRIPPER : GRIPPER + 1] + 1.0) * (high - low)
        speed, yaw = self.limits.forward * a[:, BASE_FORWARD], robot_q[:, 2]
        x, y, turn = self._base
        out[:, x] = speed * np.cos(yaw)
        out[:, y] = speed * np.sin(yaw)
        out[:, turn] = self.limits.yaw_rate * a[:, BASE_YAW]
        return out
