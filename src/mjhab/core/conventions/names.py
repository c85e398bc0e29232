"""Names of what observations can tell in two ways: axes of an object's pose, and turns of joints without limits.

`config.profiles` says which conventions a profile observes; recorded data and checkpoints hold theirs. `changes`
converts. See docs/environments.md, "Conventions of observations".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

OBJECT_AXES = "object"
SCAN_AXES = "scan"
AXES = (OBJECT_AXES, SCAN_AXES)
"""Axes of an object's pose: mjhab's, along the sides of a box; or those of its YCB scan, as the original observes."""
WRAPPED = "wrapped"
UNWRAPPED = "unwrapped"
JOINT_ANGLES = (WRAPPED, UNWRAPPED)
"""Angles of joints without limits: within half a turn; or counted on over every turn, as the original does."""


@dataclass(frozen=True)
class Conventions:
    """How observations tell poses of objects and angles of joints; the defaults are those of data that do not say.

    object_axes: one of AXES. joint_angles: one of JOINT_ANGLES.
    """

    object_axes: str = OBJECT_AXES
    joint_angles: str = UNWRAPPED

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Conventions:
        """Those among options of an environment, also of an older version, which had none to choose."""
        names = cls.__dataclass_fields__
        return cls(**{name: str(options[name]) for name in names if name in options})


PUBLISHED = Conventions(SCAN_AXES, UNWRAPPED)
"""Those of the original MS-HAB."""
