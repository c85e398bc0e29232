"""The parts of the action and its named dimensions (mani_skill/agents/robots/fetch/fetch.py).

Every mode is laid out arm, gripper, body (head pan, head tilt, torso), base. Modes differ in the arm, one in the body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mjhab.robots.fetch import model as fetch

ARM_JOINTS = (5, 7, 8, 9, 10, 11, 12)
"""Indices in FETCH_JOINTS of the seven arm joints, in action order."""
BODY_JOINTS = (4, 6, 3)
"""Head pan, head tilt, torso lift, in action order."""
FINGER_JOINTS = (13, 14)
ROOT = "torso_lift_link"
"""End effector modes are given in the frame of this link: base and torso carry the arm along."""

ARM_NAMES = tuple(fetch.FETCH_JOINTS[j] for j in ARM_JOINTS)
BODY_NAMES = tuple(fetch.FETCH_JOINTS[j] for j in BODY_JOINTS)


@dataclass(frozen=True)
class ActionLimits:
    """What an action of ±1 means."""

    joint_delta: float = 0.1
    """Arm, head [rad] and torso [m] change per control step."""
    gripper: tuple[float, float] = (-0.01, 0.05)
    """Finger position [m] at -1 and +1; below zero squeezes."""
    forward: float = 1.0
    """Base speed [m/s], forward and (holonomic) to the left."""
    yaw_rate: float = 3.14
    """Base turning speed [rad/s]."""
    joint_speed: float = 1.0
    """Arm joints in the velocity modes [rad/s]."""
    ee_move: float = 0.1
    """End effector: change per control step along each axis [m]."""
    ee_turn: float = 0.1
    """End effector: longest rotation vector per control step [rad]."""


@dataclass(frozen=True)
class ActionEntry:
    """One dimension: ``low``/``high`` in ``unit`` at -1/+1; where not ``normalized``, the action is in ``unit``."""

    name: str
    joint: str
    """The joint or link that moves."""
    low: float
    high: float
    unit: str
    frame: str
    normalized: bool = True


def joint_bounds(joint: int) -> tuple[float, float]:
    """Limits of a joint [m or rad]; ±pi where it turns freely."""
    low, high = fetch.JOINT_LIMITS[joint]
    return (low, high) if math.isfinite(low) else (-math.pi, math.pi)


def unit_of(joint: str) -> str:
    """Unit of a joint's position: only the torso slides among arm, head and torso."""
    return "m" if joint == "torso_lift_joint" else "rad"


def delta_rows(joints: tuple[str, ...], size: float, frame: str) -> tuple[ActionEntry, ...]:
    """Rows of joints that move by up to ``size`` per control step."""
    return tuple(ActionEntry(joint, joint, -size, size, unit_of(joint), frame) for joint in joints)


def absolute_rows(joints: tuple[int, ...]) -> tuple[ActionEntry, ...]:
    """Rows of joints (indices in FETCH_JOINTS) that go to a position, not normalized."""
    names = [fetch.FETCH_JOINTS[joint] for joint in joints]
    return tuple(
        ActionEntry(
            name, name, *joint_bounds(joint), unit_of(name), "joint, absolute", normalized=False
        )
        for joint, name in zip(joints, names, strict=True)
    )


def speed_rows(size: float, normalized: bool = True) -> tuple[ActionEntry, ...]:
    """Rows of the speeds of the arm joints."""
    return tuple(
        ActionEntry(f"{name}_speed", name, -size, size, "rad/s", "joint", normalized=normalized)
        for name in ARM_NAMES
    )


def gripper_row(limits: ActionLimits) -> ActionEntry:
    """Both fingers follow one number."""
    return ActionEntry(
        "gripper", "l_gripper_finger_joint", *limits.gripper, "m", "joint, absolute, both fingers"
    )


def base_rows(limits: ActionLimits, holonomic: bool) -> tuple[ActionEntry, ...]:
    """Speeds in the frame of the base at the start of the control step."""
    v = limits.forward
    w = limits.yaw_rate
    forward = ActionEntry("base_forward", "root_x_axis_joint", -v, v, "m/s", "base +x")
    left = ActionEntry("base_left", "root_y_axis_joint", -v, v, "m/s", "base +y")
    yaw = ActionEntry("base_yaw", "root_z_rotation_joint", -w, w, "rad/s", "base +z")
    return (forward, left, yaw) if holonomic else (forward, yaw)
