"""Walls of ReplicaCAD stages: every vertical rectangle of a stage mesh becomes a box behind it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.scenes.formats.gltf import TO_Z_UP, read_glb
from mjhab.scenes.spec import Geom

WALL_DEPTH_M = 0.05
"""Depth of a wall box behind its face [m]; less if the opposite face of the wall is nearer."""
MAX_NORMAL_RISE = 0.05
"""Largest vertical component of the normal of a wall face."""
_MIN_PARALLEL_COSINE = np.cos(np.radians(2.0))
_MAX_PLANE_OFFSET_M = 0.015
_GRID_STEP_M = 0.015
"""Corners closer than this along a wall count as one [m]."""
_MIN_FACE_WIDTH_M = 0.03
"""Narrower faces are left out."""
_MIN_FACE_AREA_M2 = 0.01
"""Smaller faces are left out."""
MATERIAL = "wall_white"

Extent = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Face:
    """A vertical rectangle.

    normal: (2,) unit, horizontal, towards the visible side. offset: normal . point [m]. u: extent along the wall, the
    direction of the normal rotated by +90 deg about z [m]. z: vertical extent [m].
    """

    normal: np.ndarray
    offset: float
    u: tuple[float, float]
    z: tuple[float, float]


def stage_shape(
    path: Path, rotation: np.ndarray | None = None, shift: np.ndarray | None = None
) -> tuple[tuple[Geom, ...], Extent]:
    """Compute walls and floor extent of a stage mesh, in our world axes.

    Args:
        path: the ``.glb`` of the stage.
        rotation, shift: pose of the stage in the axes of the data set, (3, 3) and (3,) [m].

    Returns:
        Wall boxes, and x_min, y_min, x_max, y_max of the mesh [m].

    Raises:
        UsageError: the file is missing or broken.
    """
    turn = TO_Z_UP if rotation is None else TO_Z_UP @ rotation
    move = np.zeros(3) if shift is None else TO_Z_UP @ shift
    return shape_of(stage_triangles(path) @ turn.T + move)


def stage_triangles(path: Path) -> np.ndarray:
    """Read the triangles (T, 3, 3) [m] of a mesh, in the axes of the data set.

    Raises:
        UsageError: the file is missing or broken.
    """
    parts = read_glb(path, textures=False)
    return np.concatenate([part.vertices[part.faces] for part in parts])


def shape_of(triangles: np.ndarray) -> tuple[tuple[Geom, ...], Extent]:
    """Compute walls and floor extent as `stage_shape` does, from triangles (T, 3, 3) [m] in our world axes."""
    low = triangles.reshape(-1, 3).min(0)
    high = triangles.reshape(-1, 3).max(0)
    faces = wall_faces(triangles)
    walls = tuple(_box(face, _depth(face, faces)) for face in faces)
    return walls, (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def wall_faces(triangles: np.ndarray) -> list[Face]:
    """Compute vertical rectangles that cover the vertical ones of the triangles (T, 3, 3) [m]."""
    normal = np.cross(
        triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    )
    size = np.linalg.norm(normal, axis=1)
    # Degenerate triangles have no normal.
    keep = (size > 1e-7) & (np.abs(normal[:, 2]) < MAX_NORMAL_RISE * size)
    triangles = triangles[keep]
    size = size[keep]
    flat = normal[keep, :2] / np.linalg.norm(normal[keep, :2], axis=1, keepdims=True)
    offset = np.einsum("tk,tck->tc", flat, triangles[:, :, :2])
    left = np.ones(len(triangles), bool)
    faces: list[Face] = []
    # Large triangles first: their planes are the most exact, and small ones join them.
    for first in np.argsort(-size, kind="stable"):
        if not left[first]:
            continue
        n = flat[first]
        away = np.abs(triangles[:, :, :2] @ n - offset[first].mean()).max(axis=1)
        same = left & (flat @ n > _MIN_PARALLEL_COSINE) & (away < _MAX_PLANE_OFFSET_M)
        # By rounding a triangle may be off its own plane.
        same[first] = True
        left &= ~same
        faces += _rectangles(triangles[same], n, float(offset[first].mean()))
    return faces


def _rectangles(triangles: np.ndarray, normal: np.ndarray, offset: float) -> list[Face]:
    """Rectangles that cover the union of triangles of one plane: cells of the grid of all corners, merged."""
    along = np.array([-normal[1], normal[0]])
    flat = np.stack([triangles[:, :, :2] @ along, triangles[:, :, 2]], axis=-1)
    us = _lines(flat[..., 0])
    zs = _lines(flat[..., 1])
    # Slivers whose corners all count as one.
    if len(us) < 2 or len(zs) < 2:
        return []
    middle = np.stack(
        np.meshgrid((us[1:] + us[:-1]) / 2, (zs[1:] + zs[:-1]) / 2, indexing="ij"),
        axis=-1,
    )
    filled = np.zeros(middle.shape[:2], bool)
    for corners in flat:
        filled |= _inside(middle, corners)
    out = []
    for i0, i1, j0, j1 in merge_cells(filled):
        u = (float(us[i0]), float(us[i1]))
        z = (float(zs[j0]), float(zs[j1]))
        width = u[1] - u[0]
        height = z[1] - z[0]
        if (
            min(width, height) >= _MIN_FACE_WIDTH_M
            and width * height >= _MIN_FACE_AREA_M2
        ):
            out.append(Face(normal, offset, u, z))
    return out


def _lines(values: np.ndarray) -> np.ndarray:
    """Sorted distinct values (n,); of values closer than `_GRID_STEP_M` the smallest is kept."""
    # Rounded, so that noise in the file does not make lines of its own.
    ordered = np.unique(values.round(4))
    keep = [float(ordered[0])]
    for value in ordered[1:]:
        if value - keep[-1] > _GRID_STEP_M:
            keep.append(float(value))
    return np.array(keep)


def _inside(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Which points (..., 2) lie in a triangle (3, 2)."""
    a = corners
    b = np.roll(corners, -1, axis=0)
    (dx, dy) = (b - a).T
    off = points[..., None, :] - a
    side = dx * off[..., 1] - dy * off[..., 0]
    # Either winding: seen along its normal a face may be turned.
    return np.all(side >= -1e-9, axis=-1) | np.all(side <= 1e-9, axis=-1)


def merge_cells(filled: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Partition the True cells of a mask (R, C) into rectangles (i0, i1, j0, j1), ends excluded."""
    out: list[tuple[int, int, int, int]] = []
    going: dict[tuple[int, int], int] = {}
    # One row more than there are: an empty one ends all rectangles.
    for i in range(len(filled) + 1):
        row = filled[i] if i < len(filled) else np.zeros(filled.shape[1], bool)
        edges = np.flatnonzero(np.diff(np.r_[0, row.astype(np.int8), 0]))
        runs = set(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
        for run in [r for r in going if r not in runs]:
            out.append((going.pop(run), i, *run))
        for run in runs:
            going.setdefault(run, i)
    return out


def _depth(face: Face, faces: list[Face]) -> float:
    """Depth [m] of the box behind a face: up to the opposite face of the wall, at most `WALL_DEPTH_M`."""
    depth = WALL_DEPTH_M
    for other in faces:
        if float(face.normal @ other.normal) > -_MIN_PARALLEL_COSINE:
            continue
        behind = face.offset + other.offset
        # u of the opposite face runs in the opposite direction.
        u = (-other.u[1], -other.u[0])
        meets = min(face.u[1], u[1]) > max(face.u[0], u[0]) and min(
            face.z[1], other.z[1]
        ) > max(face.z[0], other.z[0])
        # Nearer faces are the same wall, modelled twice.
        if meets and 0.004 < behind < depth:
            depth = behind
    return depth


def _box(face: Face, depth: float) -> Geom:
    along = np.array([-face.normal[1], face.normal[0]])
    middle = face.normal * (face.offset - depth / 2) + along * ordered_sum(face.u) / 2
    yaw = math.atan2(face.normal[1], face.normal[0])
    size = (depth / 2, (face.u[1] - face.u[0]) / 2, (face.z[1] - face.z[0]) / 2)
    pos = (float(middle[0]), float(middle[1]), ordered_sum(face.z) / 2)
    return Geom(
        "box",
        size,
        pos,
        (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))),
        MATERIAL,
    )
