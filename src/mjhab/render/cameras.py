"""Cameras of the worlds that are rendered, and where they look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mjhab.core.errors import UsageError

LEVEL_ERROR = 0.06
"""Default error allowed to levels of detail [px]; too small to be visible, also in supersampled images."""


def look_at(
    eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)
) -> np.ndarray:
    """Compute the orientation of a camera at ``eye`` that looks at ``target``, in MuJoCo's convention.

    Args:
        eye, target: (3,) in the world [m].
        up: (3,) direction that is upwards in the image; may be parallel to the line of sight.

    Returns:
        (3, 3) whose columns are the camera's axes in the world: x right, y up, z backwards.

    Raises:
        UsageError: ``eye`` and ``target`` coincide.
    """
    back = np.asarray(eye, float) - np.asarray(target, float)
    if np.linalg.norm(back) < 1e-9:
        raise UsageError(
            "look_at: eye and target are the same point; give two different points."
        )
    back /= np.linalg.norm(back)
    right = np.cross(np.asarray(up, float), back)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross((0.0, 1.0, 0.0) if abs(back[1]) < 0.9 else (1.0, 0.0, 0.0), back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back], axis=1)


@dataclass(frozen=True, eq=False)
class Cameras:
    """C cameras in each of W worlds. A camera looks along its -z, +y is up.

    Attributes:
        pos, mat: (W, C, 3) [m] and (W, C, 3, 3) (or (W, C, 9)) in the world.
        fovy: vertical field of view [rad], one number, (C,) or (W, C).
        width, height: image size [px].
        level_error: largest projected error of a level of detail that may replace a mesh [px].
    """

    pos: np.ndarray
    mat: np.ndarray
    fovy: ArrayLike
    width: int
    height: int
    level_error: float = LEVEL_ERROR
