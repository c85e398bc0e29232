"""Robots by name."""

from __future__ import annotations

from mjhab.core.registration.registry import Registry, check_item
from mjhab.robots.robot import Robot

DEFAULT_ROBOT = "fetch"
ROBOTS: Registry[Robot] = Registry(
    "robot",
    {
        "fetch": "mjhab.robots.fetch.robot:ROBOT",
        "panda_omron": "mjhab.robots.panda_omron.robot:ROBOT",
    },
)
"""All robots; a module of mjhab's own is imported when its robot is first asked for."""


def register_robot(robot: Robot) -> Robot:
    """Make a robot known to ``mjhab.make(robot=NAME)`` and to all commands.

    Returns:
        The robot, so that it can be registered where it is made.

    Raises:
        UsageError: it is no `Robot`, or its name is taken; the message says by whom.
    """
    check_item("register_robot", robot, Robot)
    return ROBOTS.add(robot.name, robot)


def robot_named(name: str = DEFAULT_ROBOT) -> Robot:
    """The robot of a name.

    Raises:
        UsageError: there is none; the message lists the names.
    """
    return ROBOTS[name]
