"""Convex pieces given by points: their hulls, minimum bounding boxes, and intersections with vertical lines."""

from __future__ import annotations

import dataclasses
import weakref

import numpy as np
from scipy.spatial import ConvexHull

from mjhab.core.arithmetic.elementary import arctan2
from mjhab.core.rotations import quat_from_mat, quat_mul, quat_rotate
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import Geom, Pack

_BOXES: weakref.WeakKeyDictionary[Mesh, tuple[np.ndarray, np.ndarray, np.ndarray]] = (
    weakref.WeakKeyDictionary()
)


_SHORTEST_EDGE_M = 1e-5
"""Edges of outlines below this length [m] have rounding errors for their direction."""


def hull_from_above(points: np.ndarray) -> np.ndarray:
    """Compute the corners (N, 2) [m], counter-clockwise, of the convex hull of points (P, 3) [m] seen from above."""
    # Seen from above, corners coincide; Qhull is exact about the rest.
    flat = np.unique(points[:, :2].round(9), axis=0)
    corners = flat[ConvexHull(flat).vertices]
    # Those of turned shapes coincide up to rounding: half-planes along such edges would cut the hull anywhere.
    step = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
    return corners[step > _SHORTEST_EDGE_M]


def smallest_box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the box of least volume around points (P, 3) that has a face parallel to a face of their hull.

    Returns:
        Its centre (3,), half-extents (3,) and rotation (3, 3), whose columns are its axes.
    """
    points = np.asarray(points, np.float64)
    hull = ConvexHull(points)
    corners = points[hull.vertices]
    normals = np.unique(hull.equations[:, :3].round(6), axis=0)
    edges = (points[hull.simplices] - points[np.roll(hull.simplices, 1, axis=1)]).reshape(
        -1, 3
    )
    best: tuple[float, np.ndarray] | None = None
    # The axes first: of equal boxes the one along the axes is kept.
    for normal in np.concatenate([np.eye(3), normals]):
        z = normal / np.linalg.norm(normal, axis=-1)
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
        x /= np.linalg.norm(x, axis=-1)
        frame = np.stack([x, np.cross(z, x), z], axis=1)
        local = corners @ frame
        flat = edges @ frame[:, :2]
        # A rectangle of least area has a side along an edge of the outline, which is a projected edge of the hull.
        angles = np.unique(
            np.append(arctan2(flat[:, 1], flat[:, 0]) % (np.pi / 2), 0.0).round(6)
        )
        c = np.cos(angles)[:, None]
        s = np.sin(angles)[:, None]
        area = np.ptp(local[:, 0] * c + local[:, 1] * s, axis=1) * np.ptp(
            local[:, 1] * c - local[:, 0] * s, axis=1
        )
        k = int(area.argmin())
        volume = float(area[k] * np.ptp(local[:, 2]))
        # Smaller by more than rounding, else the choice could differ between machines.
        if best is None or volume < best[0] * (1 - 1e-9):
            turn = np.array(
                [[c[k, 0], -s[k, 0], 0.0], [s[k, 0], c[k, 0], 0.0], [0.0, 0.0, 1.0]]
            )
            best = (volume, frame @ turn)
    assert best is not None
    rot = best[1]
    local = corners @ rot
    low = local.min(0)
    high = local.max(0)
    return rot @ ((low + high) / 2), (high - low) / 2, rot


def boxed_hull(geom: Geom, pack: Pack) -> Geom:
    """Compute the `smallest_box` around a mesh geom, as a box geom in the same frame."""
    mesh = pack.meshes[geom.mesh]
    assert isinstance(mesh, Mesh)
    if mesh not in _BOXES:
        _BOXES[mesh] = smallest_box(mesh.vertices)
    center, half, rot = _BOXES[mesh]
    # A box of least volume is another one after a scaling that is not uniform.
    if geom.size != (1.0, 1.0, 1.0):
        center, half, rot = smallest_box(mesh.vertices * np.array(geom.size))
    quat = np.array(geom.quat, float)
    pos = (np.array(geom.pos) + quat_rotate(quat, center)).tolist()
    turn = quat_mul(quat, quat_from_mat(rot)).tolist()
    return dataclasses.replace(
        geom,
        shape="box",
        size=tuple(half.tolist()),
        pos=tuple(pos),
        quat=tuple(turn),
        mesh="",
    )


def hull_mesh(points: np.ndarray) -> Mesh:
    """Compute the convex hull of points (P, 3) as a closed mesh.

    Raises:
        scipy.spatial.QhullError: the points are flat.
    """
    points = np.asarray(points, np.float64)
    hull = ConvexHull(points)
    faces = hull.simplices.copy()
    a, b, c = (points[faces[:, k]] for k in range(3))
    # Qhull winds its triangles either way.
    inward = np.einsum("fk,fk->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    # Points within the hull are left out.
    order, index = np.unique(faces, return_inverse=True)
    return Mesh(points[order].astype(np.float32), index.reshape(-1, 3).astype(np.int32))


def vertical_extent(points: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intersect vertical lines through xy (N, 2) [m] with the convex hull of points (P, 3) [m].

    Returns:
        Lowest and highest z (N,) [m] of each line inside the hull; (inf, -inf) for lines that miss it.
    """
    planes = ConvexHull(np.asarray(points, np.float64)).equations
    a, b, c, d = planes.T
    rest = xy[:, :1] * a + xy[:, 1:] * b + d
    upright = np.abs(c) < 1e-9
    with np.errstate(divide="ignore", invalid="ignore"):
        height = -rest / c
    low = np.where(c < -1e-9, height, -np.inf).max(axis=1)
    high = np.where(c > 1e-9, height, np.inf).min(axis=1)
    hit = (low <= high) & np.all(~upright | (rest <= 1e-9), axis=1)
    return np.where(hit, low, np.inf), np.where(hit, high, -np.inf)
