"""Meshes of the primitive shapes of geoms: box, cylinder, capsule, sphere. Lengths [m]."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import Geom

SEGMENTS = 24
"""Number of sides of a cylinder, and of meridians of a sphere."""


def _mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    return Mesh(
        np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32)
    )


def box_mesh(half: Sequence[float]) -> Mesh:
    """Make a box with half-extents (3,) [m], centred at the origin: 8 vertices, 12 faces."""
    corners = np.array(
        [[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float
    ) * np.asarray(half)
    quads = [
        (0, 2, 3, 1),
        (4, 5, 7, 6),
        (0, 1, 5, 4),
        (2, 6, 7, 3),
        (0, 4, 6, 2),
        (1, 3, 7, 5),
    ]
    return _mesh(
        corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    )


def _lathe(profile: Sequence[tuple[float, float]], segments: int = SEGMENTS) -> Mesh:
    """Surface of revolution about z; ``profile`` has (radius, z) [m] from bottom to top, both ends on the axis."""
    angle = np.arange(segments) * (2 * np.pi / segments)
    rings = [
        np.stack([r * np.cos(angle), r * np.sin(angle), np.full(segments, z)], 1)
        for r, z in profile[1:-1]
    ]
    vertices = np.concatenate([[[0, 0, profile[0][1]]], *rings, [[0, 0, profile[-1][1]]]])
    last = len(vertices) - 1
    k = np.arange(segments)
    n = (k + 1) % segments
    faces = [np.stack([np.zeros_like(k), 1 + n, 1 + k], 1)]
    for ring in range(len(rings) - 1):
        a = 1 + ring * segments
        b = 1 + (ring + 1) * segments
        faces += [np.stack([a + k, a + n, b + n], 1), np.stack([a + k, b + n, b + k], 1)]
    top = 1 + (len(rings) - 1) * segments
    faces.append(np.stack([top + k, top + n, np.full_like(k, last)], 1))
    return _mesh(vertices, np.concatenate(faces))


def cylinder_mesh(radius: float, half_length: float) -> Mesh:
    """Make a closed cylinder about z, centred at the origin [m]."""
    return _lathe(
        [
            (0.0, -half_length),
            (radius, -half_length),
            (radius, half_length),
            (0.0, half_length),
        ]
    )


def capsule_mesh(radius: float, half_length: float) -> Mesh:
    """Make a cylinder about z with half-spheres at its ends [m]; ``half_length``, without them, is 0 for a sphere."""
    arc = [
        (radius * np.cos(a), radius * np.sin(a)) for a in np.linspace(-np.pi / 2, 0.0, 7)
    ]
    lower = [(r, z - half_length) for r, z in arc]
    upper = [(r, half_length - z) for r, z in reversed(arc)]
    # A sphere has one equator, a capsule two.
    return _lathe(lower + (upper if half_length > 0.0 else upper[1:]))


def primitive_mesh(geom: Geom) -> Mesh:
    """Make the mesh of a box, cylinder, capsule or sphere in the geom's own frame (``pos`` and ``quat`` not applied).

    Raises:
        UsageError: the geom has another shape.
    """
    if geom.shape == "box":
        return box_mesh(geom.size)
    if geom.shape == "cylinder":
        return cylinder_mesh(geom.size[0], geom.size[1])
    if geom.shape == "capsule":
        return capsule_mesh(geom.size[0], geom.size[1])
    if geom.shape == "sphere":
        return capsule_mesh(geom.size[0], 0.0)
    raise UsageError(
        f"primitive_mesh: a geom of shape {geom.shape!r} is not a primitive; take its mesh from the pack."
    )
