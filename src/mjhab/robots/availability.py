"""Check whether the files that a robot is built from are installed."""

from __future__ import annotations

from mjhab.core.errors import MjhabError
from mjhab.robots.robot import Robot


def missing_files(robot: Robot) -> str:
    """Return which files of a robot are missing and the command that installs them; "" if none are missing."""
    try:
        # Its links are read on first use, and only then it shows that a file is missing.
        _ = robot.body
    except MjhabError as error:
        return str(error)
    return ""
