"""Meshes of robots for the eye: coarse enough to be drawn in every world."""

from __future__ import annotations

import numpy as np

from mjhab.scenes.shapes.meshes import Mesh

_CELL_M = 0.004


def coarse_mesh(vertices: np.ndarray, faces: np.ndarray, most_faces: int) -> Mesh:
    """Merge vertices on a grid that is coarsened until ``most_faces`` are left; smaller meshes stay as they are.

    Args:
        vertices: (V, 3) [m]. faces: (F, 3) indices.
    """
    cell = _CELL_M
    kept = vertices
    triangles = faces
    while len(triangles) > most_faces:
        _, index, inverse = np.unique(
            np.round(vertices / cell), axis=0, return_index=True, return_inverse=True
        )
        kept = vertices[index]
        triangles = inverse.ravel()[faces]
        a, b, c = triangles.T
        triangles = np.unique(triangles[(a != b) & (b != c) & (a != c)], axis=0)
        cell *= 1.25
    return Mesh(kept.astype(np.float32), triangles.astype(np.int32))
