"""Whether the files that a robot is made of are installed."""

from __future__ import annotations

from mjhab.core.errors import MjhabError
from mjhab.robots.robot import Robot


def missing_files(robot: Robot) -> str:
    """Message that says which files a robot lacks, and the command that installs them; "" if it lacks none."""
    try:
        _ = robot.body
    except MjhabError as error:
        return str(error)
    return ""
