"""Control modes of a robot: named actions, and what the actuators are told (mani_skill/agents/controllers)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjhab.core.arrays import Array
from mjhab.core.errors import UsageError
from mjhab.robots.controllers.arm import ArmRequest
from mjhab.robots.controllers.controller import BASES, STATIONARY, Controller
from mjhab.robots.controllers.modes import (
    CONTROL_MODES,
    DEFAULT_MODE,
    ControlMode,
    register_control_mode,
)
from mjhab.robots.controllers.table import ActionEntry
from mjhab.robots.parts import ActionLimits
from mjhab.robots.registry import robot_named
from mjhab.robots.robot import Robot

__all__ = [
    "BASES",
    "CONTROL_MODES",
    "DEFAULT_MODE",
    "STATIONARY",
    "ActionEntry",
    "ActionLimits",
    "ControlMode",
    "Controller",
    "check_actions",
    "make_controller",
    "register_control_mode",
]


def make_controller(
    mode: str = DEFAULT_MODE,
    num_worlds: int = 1,
    *,
    robot: Robot | None = None,
    base: str = "forward",
    stationary: Sequence[str] = (),
    limits: ActionLimits | None = None,
    like: Array | None = None,
) -> Controller:
    """The controller of a mode.

    Args:
        mode: one of CONTROL_MODES.
        num_worlds: W.
        robot: whom to command; the default robot if not given.
        base: "forward" ([forward, yaw rate], as MS-HAB) or "holonomic" ([forward, left, yaw rate]).
        stationary: parts whose numbers count as zero, of "head", "torso", "base" (mshab/envs/wrappers/action.py); a
            stiff body holds them where they were at the reset.
        limits: what ±1 means; that of the robot if not given.
        like: an array of the library, device and dtype of the simulator's joint positions; numpy float64 if not given.

    Raises:
        UsageError: a name that is not in these lists, or a mode of a plugin that makes no arm controller.
    """
    chosen = CONTROL_MODES[mode]
    robot = robot or robot_named()
    limits = limits or robot.limits
    request = ArmRequest(robot, num_worlds, limits, np.zeros(0) if like is None else like)
    return Controller(
        mode,
        robot,
        chosen.arm(request),
        limits,
        stiff_body=chosen.stiff_body,
        base=base,
        stationary=stationary,
    )


def check_actions(actions: np.ndarray, table: Sequence[ActionEntry], num_worlds: int) -> np.ndarray:
    """Actions of any number type as float32 (W, A).

    Raises:
        UsageError: wrong shape or type, or a number that is not finite: says in which world and dimension.
    """
    actions = np.asarray(actions)
    if actions.dtype.kind not in "fiu":
        raise UsageError(f"actions must be numbers (float32), got an array of type {actions.dtype}")
    if actions.shape != (num_worlds, len(table)):
        raise UsageError(
            f"actions must have shape ({num_worlds}, {len(table)}), got {actions.shape}"
        )
    if not np.isfinite(actions).all():
        world, dim = (int(i) for i in np.argwhere(~np.isfinite(actions))[0])
        raise UsageError(
            f"actions must be finite; world {world} has {actions[world, dim]} in dimension {dim} ({table[dim].name})"
        )
    return actions.astype(np.float32, copy=False)
