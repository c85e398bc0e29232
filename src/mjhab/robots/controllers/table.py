"""Entries of an action with names, ranges and units, as in ManiSkill's agents (mani_skill/agents/robots).

The order of an action is arm, gripper, head, torso, base.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mjhab.robots.parts import ActionLimits
from mjhab.robots.robot import Robot


@dataclass(frozen=True)
class ActionEntry:
    """One entry of an action.

    Attributes:
        name: name of the entry.
        joint: joint or link that it moves.
        low: value in ``unit`` at action -1.
        high: value in ``unit`` at action +1.
        unit: physical unit, e.g. "rad".
        frame: frame or reference of the value.
        normalized: actions are in [-1, 1]; False: they are in ``unit``, between ``low`` and ``high``.
    """

    name: str
    joint: str
    """The joint or link that moves."""
    low: float
    high: float
    unit: str
    frame: str
    normalized: bool = True


def joint_bounds(robot: Robot, joint: str) -> tuple[float, float]:
    """Return the limits (low, high) of a joint [m or rad]; ±pi for a joint without limits."""
    low, high = robot.joint_limits[robot.joints.index(joint)]
    return (low, high) if math.isfinite(low) else (-math.pi, math.pi)


def unit_of(robot: Robot, joint: str) -> str:
    """Return the unit of a joint's position: "m" or "rad"."""
    return "m" if joint in robot.sliding else "rad"


def delta_rows(
    robot: Robot, joints: tuple[str, ...], size: float, frame: str
) -> tuple[ActionEntry, ...]:
    """Return the entries of joints for position changes of up to ``size`` [m or rad] per control step."""
    return tuple(
        ActionEntry(joint, joint, -size, size, unit_of(robot, joint), frame)
        for joint in joints
    )


def absolute_rows(robot: Robot, joints: tuple[str, ...]) -> tuple[ActionEntry, ...]:
    """Return the entries of joints for absolute positions [m or rad], not normalized."""
    return tuple(
        ActionEntry(
            joint,
            joint,
            *joint_bounds(robot, joint),
            unit_of(robot, joint),
            "joint, absolute",
            normalized=False,
        )
        for joint in joints
    )


def speed_rows(
    robot: Robot, limits: ActionLimits, normalized: bool = True
) -> tuple[ActionEntry, ...]:
    """Return the entries of the arm joints for speeds [rad/s]."""
    size = limits.joint_speed
    return tuple(
        ActionEntry(
            f"{name}_speed", name, -size, size, "rad/s", "joint", normalized=normalized
        )
        for name in robot.group("arm")
    )


def gripper_row(robot: Robot, limits: ActionLimits) -> ActionEntry:
    """Return the gripper's entry: one position [m] for both fingers."""
    # One entry for both: the fingers of a parallel gripper mirror each other (mimic joint of ManiSkill).
    finger = robot.group("fingers")[-1]
    return ActionEntry(
        "gripper", finger, *limits.gripper, "m", "joint, absolute, both fingers"
    )


def base_rows(
    robot: Robot, limits: ActionLimits, holonomic: bool
) -> tuple[ActionEntry, ...]:
    """Return the entries of the base: speeds in the base frame at the start of the control step [m/s, rad/s]."""
    v = limits.forward
    w = limits.yaw_rate
    x, y, turn = robot.group("base")
    forward = ActionEntry("base_forward", x, -v, v, "m/s", "base +x")
    left = ActionEntry("base_left", y, -v, v, "m/s", "base +y")
    yaw = ActionEntry("base_yaw", turn, -w, w, "rad/s", "base +z")
    return (forward, left, yaw) if holonomic else (forward, yaw)
