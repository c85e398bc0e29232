"""Fast mesh simplification: vertex clustering with error quadrics, for meshes that are only rendered."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

_CELL_SHARES = (0.25, 0.005)
"""Edges of the coarsest and the finest cell, as fractions of the largest extent of the mesh."""
_BISECTIONS = 9
_STIFFNESS = 1e-3
"""Weight that pulls a merged vertex to the mean of its cell in directions that the planes do not determine."""


@dataclass(frozen=True, eq=False)
class Simplified:
    """A mesh with fewer faces: ``vertices`` (v, 3), ``faces`` (f, 3); ``source`` (f,): face of the original mesh that
    each face comes from, with its corners in the same order."""

    vertices: np.ndarray
    faces: np.ndarray
    source: np.ndarray


def simplify(vertices: np.ndarray, faces: np.ndarray, max_faces: int) -> Simplified:
    """Merge the vertices of a triangle mesh in the cells of a grid, with the finest grid that meets a face budget.

    Vertices whose normals are nearest to different axis directions are never merged, so that both sides of a thin wall
    remain. A merged vertex minimises the quadric error to the planes of its faces (Garland and Heckbert 1997, per cell
    as in Lindstrom 2000), so that edges stay sharp.

    Args:
        vertices: (V, 3).
        faces: (F, 3) indices.
        max_faces: largest number of faces; a mesh with no more is returned unchanged.
    """
    vertices = np.asarray(vertices, np.float64)
    faces = np.asarray(faces, np.int64)
    if len(faces) <= max_faces:
        return Simplified(vertices, faces, np.arange(len(faces)))
    side = _sides(vertices, faces)
    size = float(np.ptp(vertices, axis=0).max())
    # Bisected on a scale of ratios, since the number of faces goes with the square of the cell.
    fine = math.log(_CELL_SHARES[1] * size)
    coarse = math.log(_CELL_SHARES[0] * size)
    # The coarsest one is the answer if no finer grid meets the budget.
    best = _cluster(vertices, faces, side, math.exp(coarse))
    for _ in range(_BISECTIONS):
        middle = (fine + coarse) / 2
        found = _cluster(vertices, faces, side, math.exp(middle))
        if len(found[1]) <= max_faces:
            best = found
            coarse = middle
        else:
            fine = middle
    label, source = best
    return Simplified(_merged(vertices, faces, label), label[faces[source]], source)


def _sides(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) index 0..5 of the axis direction nearest to the normal of each vertex."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normal, faces[:, k], np.cross(b - a, c - a))
    axis = np.abs(normal).argmax(axis=1)
    return 2 * axis + (np.take_along_axis(normal, axis[:, None], 1)[:, 0] > 0)


def _cluster(
    vertices: np.ndarray, faces: np.ndarray, side: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """Cluster (V,) of every vertex; faces (f,) whose corners are in three clusters, without duplicates."""
    grid = np.floor((vertices - vertices.min(axis=0)) / cell).astype(np.int64)
    width = grid.max(axis=0) + 1
    # One number per cell and side, which sorts faster than rows.
    key = ((grid[:, 0] * width[1] + grid[:, 1]) * width[2] + grid[:, 2]) * 6 + side
    found, label = np.unique(key, return_inverse=True)
    new = label[faces]
    kept = np.flatnonzero(
        (new[:, 0] != new[:, 1]) & (new[:, 1] != new[:, 2]) & (new[:, 2] != new[:, 0])
    )
    new = new[kept]
    # The smallest corner first: equal faces are equal rows, but keep their winding.
    turn = new.argmin(axis=1)
    rolled = np.take_along_axis(new, (turn[:, None] + np.arange(3)) % 3, axis=1)
    count = len(found)
    _, first = np.unique(
        (rolled[:, 0] * count + rolled[:, 1]) * count + rolled[:, 2], return_index=True
    )
    return label, kept[first]


def _merged(vertices: np.ndarray, faces: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Position (v, 3) of every cluster: the point of least quadric error to the planes of its faces."""
    count = int(label.max()) + 1
    share = np.bincount(label, minlength=count)
    mean = (
        np.stack([np.bincount(label, vertices[:, k], count) for k in range(3)], axis=1)
        / share[:, None]
    )
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    normal = normal / np.maximum(area, 1e-30)[:, None]
    outer = area[:, None, None] * normal[:, :, None] * normal[:, None, :]
    matrix = np.zeros((count, 3, 3))
    right = np.zeros((count, 3))
    for k in range(3):
        at = label[faces[:, k]]
        # Planes relative to the mean of the cell, for numerical precision.
        offset = np.einsum("ij,ij->i", normal, a - mean[at])
        np.add.at(matrix, at, outer)
        np.add.at(right, at, (area * offset)[:, None] * normal)
    trace = np.maximum(np.trace(matrix, axis1=1, axis2=2), 1e-30)
    matrix = matrix / trace[:, None, None] + _STIFFNESS * np.eye(3)
    place = mean + np.linalg.solve(matrix, (right / trace[:, None])[..., None])[..., 0]
    low = np.full((count, 3), np.inf)
    high = np.full((count, 3), -np.inf)
    np.minimum.at(low, label, vertices)
    np.maximum.at(high, label, vertices)
    # Nearly parallel planes may intersect far outside of the cell.
    return np.clip(place, low, high)
