"""Robots by name."""

from __future__ import annotations

import importlib

from mjhab.core.errors import UsageError, unknown_name
from mjhab.robots.robot import Robot

DEFAULT_ROBOT = "fetch"
_BUILTIN = {"fetch": "mjhab.robots.fetch.robot"}
"""Name to the module whose ``ROBOT`` it is; imported when the robot is first asked for."""
_REGISTERED: dict[str, Robot] = {}


def register_robot(robot: Robot) -> Robot:
    """Make a robot known to ``mjhab.make(robot=NAME)`` and to all commands.

    Returns:
        The robot, so that it can be registered where it is made.

    Raises:
        UsageError: its name is taken.
    """
    if robot.name in robot_names():
        raise UsageError(
            f"robot {robot.name!r} is registered already; give the second one another name."
        )
    _REGISTERED[robot.name] = robot
    return robot


def robot_names() -> tuple[str, ...]:
    """Names of all robots, those that ship with mjhab first."""
    return tuple(dict.fromkeys((*_BUILTIN, *_REGISTERED)))


def robot_named(name: str = DEFAULT_ROBOT) -> Robot:
    """The robot of a name.

    Raises:
        UsageError: there is none; the message lists the names.
    """
    if name not in _REGISTERED:
        if name not in _BUILTIN:
            raise unknown_name("robot", name, robot_names())
        _REGISTERED[name] = importlib.import_module(_BUILTIN[name]).ROBOT
    return _REGISTERED[name]
