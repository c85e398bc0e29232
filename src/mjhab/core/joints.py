"""Where the groups of a robot's joints are in arrays of joint positions and speeds.

Every robot has its joints in one order: the base (x, y, yaw), then the joints of its posture (torso, head and arm, in
any order), then the fingers. Code that is no part of a robot takes columns from here and names no number.
"""

from __future__ import annotations

from dataclasses import dataclass

GROUPS = ("base", "torso", "head", "arm", "fingers")
"""Names of the groups of joints that robots may have."""
BASE = slice(0, 3)
"""Columns of the base: x, y [m] and yaw [rad] in the world."""
BASE_X = 0
BASE_Y = 1
BASE_XY = slice(0, 2)
BASE_YAW = 2


@dataclass(frozen=True)
class JointColumns:
    """Columns of a robot with ``count`` joints."""

    count: int
    fingers: slice
    """The joints of the fingers, the last ones; empty where there are none."""
    torso: int | None
    """The joint that lifts the arm, None where nothing does."""

    @property
    def posture(self) -> slice:
        """Torso, head and arm: all joints but those of base and fingers."""
        return slice(BASE.stop, self.fingers.start)

    @property
    def body(self) -> slice:
        """All joints but those of the fingers."""
        return slice(0, self.fingers.start)

    @property
    def upper(self) -> slice:
        """All joints but those of the base."""
        return slice(BASE.stop, self.count)
