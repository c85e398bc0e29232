"""The parts of the action and its named dimensions, as in ManiSkill's agents (mani_skill/agents/robots).

Every mode is laid out arm, gripper, body (head, torso), base. Modes differ in the arm, one in the body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mjhab.robots.parts import ActionLimits
from mjhab.robots.robot import Robot


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


def joint_bounds(robot: Robot, joint: str) -> tuple[float, float]:
    """Limits of a joint [m or rad]; ±pi where it turns freely."""
    low, high = robot.joint_limits[robot.joints.index(joint)]
    return (low, high) if math.isfinite(low) else (-math.pi, math.pi)


def unit_of(robot: Robot, joint: str) -> str:
    """Unit of a joint's position."""
    return "m" if joint in robot.sliding else "rad"


def delta_rows(
    robot: Robot, joints: tuple[str, ...], size: float, frame: str
) -> tuple[ActionEntry, ...]:
    """Rows of joints that move by up to ``size`` per control step."""
    return tuple(
        ActionEntry(joint, joint, -size, size, unit_of(robot, joint), frame) for joint in joints
    )


def absolute_rows(robot: Robot, joints: tuple[str, ...]) -> tuple[ActionEntry, ...]:
    """Rows of joints that go to a position, not normalized."""
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
    """Rows of the speeds of the arm joints."""
    size = limits.joint_speed
    return tuple(
        ActionEntry(f"{name}_speed", name, -size, size, "rad/s", "joint", normalized=normalized)
        for name in robot.group("arm")
    )


def gripper_row(robot: Robot, limits: ActionLimits) -> ActionEntry:
    """The row of the gripper: one command for both fingers."""
    finger = robot.group("fingers")[-1]
    return ActionEntry("gripper", finger, *limits.gripper, "m", "joint, absolute, both fingers")


def base_rows(robot: Robot, limits: ActionLimits, holonomic: bool) -> tuple[ActionEntry, ...]:
    """Speeds in the frame of the base at the start of the control step."""
    v = limits.forward
    w = limits.yaw_rate
    x, y, turn = robot.group("base")
    forward = ActionEntry("base_forward", x, -v, v, "m/s", "base +x")
    left = ActionEntry("base_left", y, -v, v, "m/s", "base +y")
    yaw = ActionEntry("base_yaw", turn, -w, w, "rad/s", "base +z")
    return (forward, left, yaw) if holonomic else (forward, yaw)
