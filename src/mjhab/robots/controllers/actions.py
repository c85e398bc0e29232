"""The 13-D action of the default mode ``pd_joint_delta_pos``, which policies and experts speak.

What the numbers of every mode mean, and how they become commands, is in `mjhab.robots.controllers`.
"""

from __future__ import annotations

from mjhab.robots.controllers import ActionEntry, ActionLimits, make_controller
from mjhab.robots.controllers.table import ARM_JOINTS

__all__ = [
    "ACTION_DIM",
    "ARM",
    "ARM_JOINTS",
    "BASE_FORWARD",
    "BASE_YAW",
    "GRIPPER",
    "HEAD_PAN",
    "HEAD_TILT",
    "TORSO",
    "ActionEntry",
    "ActionLimits",
    "action_table",
]

ARM = slice(0, 7)
GRIPPER = 7
HEAD_PAN = 8
HEAD_TILT = 9
TORSO = 10
BASE_FORWARD = 11
BASE_YAW = 12
ACTION_DIM = 13


def action_table(limits: ActionLimits | None = None) -> tuple[ActionEntry, ...]:
    """Name, meaning and bounds of every dimension of the default action, in order."""
    return make_controller(limits=limits).table
