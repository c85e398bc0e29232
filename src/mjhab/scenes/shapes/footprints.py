"""Footprints of templates on the floor, and tests whether two of them overlap."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from mjhab.core.rotations import mat_from_quat
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import Articulation, Geom, Placement, Prop


@dataclass(frozen=True, eq=False)
class FloorPolygon:
    """A convex polygon on the floor with a height interval, in the world: ``corners`` (N, 2), ``z`` (low, high) [m]."""

    name: str
    corners: np.ndarray
    z: tuple[float, float]

    @cached_property
    def box(self) -> tuple[float, float, float, float]:
        """Axis-aligned bounds: x_min, y_min, x_max, y_max [m]."""
        x, y = self.corners.T.tolist()
        return min(x), min(y), max(x), max(y)

    def meets(self, other: FloorPolygon) -> bool:
        """Return whether the two overlap in plan and height."""
        a = self.box
        b = other.box
        # Nearly all pairs are far apart, and comparing boxes is much faster than edges.
        if a[0] > b[2] or b[0] > a[2] or a[1] > b[3] or b[1] > a[3]:
            return False
        return (
            self.z[0] < other.z[1]
            and other.z[0] < self.z[1]
            and meet(self.corners, other.corners)
        )


def outline(geom: Geom, meshes: Mapping[str, object] | None = None) -> np.ndarray:
    """Compute points (P, 3) [m] in the template's frame whose convex hull contains the geom.

    The hull is exact for boxes and the convex hull of meshes, and circumscribed for curved shapes.

    Args:
        geom: of any shape.
        meshes: meshes by name, for geoms of shape "mesh".
    """
    if geom.shape == "mesh":
        mesh = (meshes or {})[geom.mesh]
        assert isinstance(mesh, Mesh)
        points = mesh.vertices.astype(float) * np.array(geom.size)
    elif geom.shape == "box":
        points = _signs() * np.array(geom.size)
    else:
        r = geom.size[0]
        half = {"sphere": r, "cylinder": geom.size[1], "capsule": geom.size[1] + r}[
            geom.shape
        ]
        angle = np.linspace(0.0, 2 * math.pi, 16, endpoint=False)
        # Circumscribed: an outline must not be smaller than the shape.
        ring = np.stack([np.cos(angle), np.sin(angle)], 1) * (r / math.cos(math.pi / 16))
        points = np.concatenate(
            [np.column_stack([ring, np.full(16, s * half)]) for s in (-1.0, 1.0)]
        )
    return points @ mat_from_quat(np.array(geom.quat)).T + np.array(geom.pos)


def _signs() -> np.ndarray:
    return np.array(
        [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]
    )


def bounds(
    geoms: Iterable[Geom], meshes: Mapping[str, object] | None = None
) -> np.ndarray:
    """Compute the bounds (2, 3) [m], lower and upper, of the colliding geoms, in the frame of their template.

    Raises:
        ValueError: none of the geoms collides.
    """
    points = [outline(g, meshes) for g in geoms if g.collide]
    if not points:
        raise ValueError("no colliding geom")
    stacked = np.concatenate(points)
    return np.stack([stacked.min(0), stacked.max(0)])


def all_geoms(template: Prop | Articulation) -> tuple[Geom, ...]:
    """Return the geoms of a template in its frame, links of articulations closed."""
    if isinstance(template, Prop):
        return template.geoms
    moved = [
        Geom(
            g.shape,
            g.size,
            (g.pos[0] + k.pos[0], g.pos[1] + k.pos[1], g.pos[2] + k.pos[2]),
            g.quat,
            g.material,
            g.mesh,
            g.collide,
            g.visual,
        )
        for k in template.links
        for g in k.geoms
    ]
    return (*template.geoms, *moved)


def rectangle(
    placement: Placement, x: tuple[float, float], y: tuple[float, float]
) -> np.ndarray:
    """Compute the corners (4, 2) [m] in the world of a rectangle with extents x, y [m] in a placed template's frame."""
    local = np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]])
    return turned(placement, local)


def turned(placement: Placement, local: np.ndarray) -> np.ndarray:
    """Points (..., N, 2) [m] in the world of points on the floor of an upright template's frame."""
    c = math.cos(placement.yaw)
    s = math.sin(placement.yaw)
    return local @ np.array([[c, s], [-s, c]]) + np.array(placement.pos[:2])


@cache
def _extent(template: Prop | Articulation) -> np.ndarray | None:
    geoms = [g for g in all_geoms(template) if g.collide]
    return bounds(geoms) if geoms else None


def footprint(placement: Placement, template: Prop | Articulation) -> FloorPolygon | None:
    """Compute the footprint of a placed template: its bounding rectangle; None if it has no colliding geom."""
    extent = _extent(template)
    if extent is None:
        return None
    low, high = extent
    corners = rectangle(placement, (low[0], high[0]), (low[1], high[1]))
    lift = placement.pos[2]
    return FloorPolygon(placement.template, corners, (low[2] + lift, high[2] + lift))


def meet(a: np.ndarray, b: np.ndarray, gap: float = 0.0) -> bool:
    """Return whether two convex polygons (N, 2), (M, 2) are closer than ``gap`` [m] along every edge normal.

    With ``gap`` 0 this is the separating axis test for overlap.
    """
    for polygon in (a, b):
        edges = np.roll(polygon, -1, axis=0) - polygon
        normals = np.stack([edges[:, 1], -edges[:, 0]], 1)
        # Unit length, so that the gap is in metres.
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        pa = a @ normals.T
        pb = b @ normals.T
        if np.any(np.maximum(pa.min(0) - pb.max(0), pb.min(0) - pa.max(0)) >= gap):
            return False
    return True
