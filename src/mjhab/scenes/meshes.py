"""Triangle meshes of the render scene and of convex collision pieces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle soup. ``vertices`` (V, 3) [m] float32; ``faces`` (F, 3) int32, counter-clockwise outside.

    ``face_color``: (F, 3) float32 in 0..1 (sRGB) or None, then the material of the geom gives the colour.
    """

    vertices: np.ndarray
    faces: np.ndarray
    face_color: np.ndarray | None = None
