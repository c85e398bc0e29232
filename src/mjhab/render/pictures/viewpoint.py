"""Where a picture is taken from: position, what it looks at, and field of view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjhab.render.cameras import Cameras, look_at
from mjhab.scenes.spec import Home

PLAN_HEIGHT_M = 1000.0
"""Height of the camera of a plan: so far that what stands 1 m above the floor and 5 m from the middle is 5 mm off."""
PLAN_MARGIN = 1.06
"""Side of a plan by that of the floor."""
UP = (0.0, 0.0, 1.0)


class Viewpoint(NamedTuple):
    """A camera.

    eye, target: (3,) position and what it looks at, in the world [m]. fovy: vertical field of view [rad]. up: (3,)
    direction that is upwards in the image.
    """

    eye: np.ndarray
    target: np.ndarray
    fovy: float
    up: Sequence[float] | np.ndarray = UP

    @property
    def mat(self) -> np.ndarray:
        """(3, 3) its axes in the world: x right, y up, z backwards."""
        return look_at(self.eye, self.target, self.up)


def cameras_of(views: Sequence[Viewpoint], width: int, height: int) -> Cameras:
    """The cameras of one world at some viewpoints, with images of ``width`` x ``height`` [px]."""
    return Cameras(
        np.array([[view.eye for view in views]], float),
        np.array([[view.mat for view in views]]),
        np.array([[view.fovy for view in views]]),
        width,
        height,
    )


def one_camera_each(views: Sequence[Viewpoint], width: int, height: int) -> Cameras:
    """The cameras of as many worlds as viewpoints, one in each, with images of ``width`` x ``height`` [px]."""
    one = cameras_of(views, width, height)
    pos, mat, fovy = (
        part.swapaxes(0, 1) for part in (one.pos, one.mat, np.asarray(one.fovy))
    )
    return Cameras(pos, mat, fovy, width, height)


def plan_of(home: Home, width: int, height: int) -> Viewpoint:
    """A plan of a home: everything from straight above, verticals as points, without the ceiling.

    It is turned by 90 deg if that puts the long side of the floor along the long side of the image.
    """
    center, size, up = floor_of(home, width, height)
    # The tighter side of the image decides.
    side = PLAN_MARGIN * max(size[1], size[0] * height / width)
    eye = center + np.array([0.0, 0.0, PLAN_HEIGHT_M])
    return Viewpoint(eye, center, 2.0 * np.arctan(0.5 * side / PLAN_HEIGHT_M), up)


def floor_of(
    home: Home, width: int, height: int
) -> tuple[np.ndarray, np.ndarray, tuple[float, float, float]]:
    """Middle (3,) of a floor, its extent (2,) across and along an image of this size [m], and the upward direction."""
    x0, y0, x1, y1 = home.floor
    center = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0])
    size = np.array([x1 - x0, y1 - y0])
    if (size[1] > size[0]) != (height > width):
        return center, size[::-1], (1.0, 0.0, 0.0)
    return center, size, (0.0, 1.0, 0.0)
