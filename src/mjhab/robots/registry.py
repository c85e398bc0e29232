"""Registry of robots by name."""

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
"""All robots. The module of a built-in robot is imported on the first look-up of its name."""


def register_robot(robot: Robot) -> Robot:
    """Make a robot known to ``mjhab.make(robot=NAME)`` and to all commands.

    Returns:
        ``robot``, so that the call can wrap its construction.

    Raises:
        UsageError: ``robot`` is not a `Robot`, or its name is taken; the message says by which module.
    """
    check_item("register_robot", robot, Robot)
    return ROBOTS.add(robot.name, robot)


def robot_named(name: str = DEFAULT_ROBOT) -> Robot:
    """Return the robot with a name.

    Raises:
        UsageError: there is none; the message lists the names.
    """
    return ROBOTS[name]
