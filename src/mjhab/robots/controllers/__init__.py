"""Control modes of a robot: named actions and the actuator commands they become (mani_skill/agents/controllers)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjhab.core.arrays import Array
from mjhab.core.errors import wrong_value
from mjhab.core.typed.checks import check, check_shape
from mjhab.robots.controllers.arm import ArmRequest
from mjhab.robots.controllers.controller import BASES, STATIONARY, BodyOptions, Controller
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
    like: Array | None = None,
) -> Controller:
    """Make the controller of a control mode for W worlds.

    Args:
        mode: one of CONTROL_MODES.
        num_worlds: W.
        robot: the robot to command, with the ranges that actions of ±1 are scaled to; None for the default robot.
        base: "forward" ([forward, yaw rate], as in MS-HAB) or "holonomic" ([forward, left, yaw rate]).
        stationary: parts of "head", "torso" and "base" whose entries of the action are taken as zero
            (mshab/envs/wrappers/action.py); with a stiff body they hold their positions of the last reset.
        like: an array of the library, device and dtype of the simulator's joint positions; None for numpy float64.

    Raises:
        UsageError: unknown mode, base control or part, or a plugin's mode does not return an arm controller.
    """
    chosen = CONTROL_MODES[mode]
    robot = robot or robot_named()
    like = np.zeros(0) if like is None else like
    request = ArmRequest(robot, num_worlds, robot.limits, like)
    return Controller(
        mode,
        robot,
        chosen.arm(request),
        BodyOptions(chosen.stiff_body, base, stationary),
    )


def check_actions(
    actions: np.ndarray, table: Sequence[ActionEntry], num_worlds: int
) -> np.ndarray:
    """Check actions and return them as float32 (W, A).

    Args:
        actions: (W, A) of any number type.
        table: the A entries of the action.
        num_worlds: W.

    Raises:
        UsageError: wrong shape or type, or a value is not finite in float32; the message names its world and dimension.
    """
    actions = np.asarray(actions)
    check(actions.dtype.kind in "fiu", "actions", actions.dtype, "numbers (float32)")
    check_shape("actions", actions, (num_worlds, len(table)))
    # Numbers beyond float32 become infinite.
    with np.errstate(over="ignore"):
        actions = actions.astype(np.float32, copy=False)
    if not np.isfinite(actions).all():
        world, dim = (int(i) for i in np.argwhere(~np.isfinite(actions))[0])
        raise wrong_value(
            "actions",
            float(actions[world, dim]),
            "finite",
            f"It is in dimension {dim} ({table[dim].name}) of world {world}.",
        )
    return actions
