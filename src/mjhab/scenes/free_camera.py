"""Cameras that people put somewhere: texts such as "1,2,1.5" for places, checked before anything is drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np

from mjhab.core.errors import missing_field, wrong_value
from mjhab.core.typed.flags import Flag

FOV_DEG = 55.0
"""Default vertical field of view [degrees]."""
FARTHEST_M = 10_000.0
"""Largest coordinate of a camera [m]."""

Place = Annotated[
    str | tuple[float, ...] | None,
    Flag(metavar="X,Y,Z", kind=str | None, shown="default: none"),
]
"""A field with a place in the world [m]: a text on the command line, in Python also three numbers."""


class FreeCamera(NamedTuple):
    """eye, target: (3,) where a camera is and what it looks at [m]. fovy: vertical field of view [rad]."""

    eye: np.ndarray
    target: np.ndarray
    fovy: float


def place_of(option: str, value: Any) -> np.ndarray:
    """A place (3,) in the world [m].

    Args:
        option: what has the value, for messages.
        value: a text such as "1,2,1.5", or three numbers.

    Raises:
        UsageError: it is neither.
    """
    parts: Sequence[Any] = value.split(",") if isinstance(value, str) else value
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        numbers = []
    good = len(numbers) == 3 and all(
        math.isfinite(x) and abs(x) <= FARTHEST_M for x in numbers
    )
    if not good:
        raise wrong_value(
            option, value, "a place in meters: three numbers x,y,z such as 1.5,2,1.6"
        )
    return np.array(numbers)


def free_camera(camera: Any, look_at: Any, fov_deg: float) -> FreeCamera | None:
    """A camera, None if none is asked for.

    Args:
        camera, look_at: places, see `place_of`; None for none. Without ``look_at`` the target is nan.
        fov_deg: vertical field of view [degrees].

    Raises:
        UsageError: a value is none, ``look_at`` comes without ``camera``, or both are the same place.
    """
    # NaN, which differs from every place, stands for the default of the caller.
    target = np.full(3, np.nan) if look_at is None else place_of("look_at", look_at)
    if camera is None:
        if look_at is not None:
            raise missing_field("camera", advice="Say where it stands: --camera x,y,z")
        return None
    eye = place_of("camera", camera)
    if np.linalg.norm(eye - target, axis=-1) < 1e-6:
        raise wrong_value("look_at", look_at, "another place than that of the camera")
    return FreeCamera(eye, target, math.radians(fov_deg))
