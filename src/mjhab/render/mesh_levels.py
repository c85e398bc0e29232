"""Levels of detail of a mesh, with the shading attributes of every face; cached on disk for large meshes.

Attributes that vary over a face (normal, texture coordinates) are stored as an affine map of the point in the frame of
the mesh, so that shading a pixel needs no barycentric coordinates.
"""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from mjhab.core.arithmetic.digest import arithmetic_digest
from mjhab.core.files.cache import cache_dir, write_cached
from mjhab.core.files.code_digest import code_digest
from mjhab.scenes.shapes.collapse import collapse, distance_to_faces
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.shapes.simplify import Simplified, simplify
from mjhab.scenes.shapes.winding import reversed_where, turned_outwards

CREASE = np.cos(np.radians(40.0))
"""Cosine of the crease angle: faces whose normals differ by less than 40 deg are shaded as one smooth surface."""
MIN_FACES = 64
"""Meshes with fewer faces have one level only."""
_STEP = 2.0
"""Ratio of the targeted numbers of faces of consecutive levels."""
_FEWEST = 16
"""Approximate number of faces of the coarsest level that is tried."""
MOST_KEPT = 0.7
"""A level with more than this fraction of the faces of the one before is left out."""
MOST_COLLAPSED = 5_000
"""Meshes with more faces are first reduced to about this number by `simplify`, which is faster but less exact."""


@dataclass(frozen=True, eq=False)
class Level:
    """One level of detail. V vertices, F faces.

    Attributes:
        vertices: (V, 3) f32 [m] in the frame of the mesh, without duplicates.
        faces: (F, 3) i32, indices into ``vertices``.
        source: (F,) i32, face of the original mesh whose material and texture each face takes.
        normal: (F, 3, 4) f32; ``normal @ (p, 1)`` is the unnormalised normal at point p, constant on flat faces.
        uv: (F, 2, 4) f32; ``uv @ (p, 1)`` are the texture coordinates at point p.
        density: (F,) f32, length in texture coordinates (0..1) per length on the face [1/m].
        error: (1,) f64, upper bound of the distance of the original mesh's vertices to this level [m].
    """

    vertices: np.ndarray
    faces: np.ndarray
    source: np.ndarray
    normal: np.ndarray
    uv: np.ndarray
    density: np.ndarray
    error: np.ndarray


def mesh_levels(mesh: Mesh) -> list[Level]:
    """Compute the levels of detail of a mesh, or read them from the cache.

    Returns:
        The levels, finest first; the first has the faces of the mesh itself, closed surfaces turned outwards. One level
        below `MIN_FACES` faces.
    """
    if len(mesh.faces) < MIN_FACES:
        # Small meshes are made faster than they are read.
        return _make(mesh)
    path = cache_dir() / "meshes" / f"{_digest(mesh)}.npz"
    found = _load(path)
    if found is None:
        found = _make(mesh)
        names = [f.name for f in fields(Level)]
        arrays = {
            f"{k}/{name}": getattr(level, name)
            for k, level in enumerate(found)
            for name in names
        }
        write_cached(
            path, lambda temporary: np.savez(temporary, allow_pickle=False, **arrays)
        )
    return found


def _digest(mesh: Mesh) -> str:
    digest = hashlib.sha256(
        code_digest(
            "render.mesh_levels",
            "scenes.shapes.collapse",
            "scenes.shapes.simplify",
            "scenes.shapes.winding",
        )
        + arithmetic_digest()
    )
    for part in (mesh.vertices, mesh.faces, mesh.uv):
        digest.update(b"" if part is None else part.tobytes())
    return digest.hexdigest()[:24]


def _load(path: Path) -> list[Level] | None:
    """Levels from a cache file; None if it does not exist or cannot be read, in which case they are computed again."""
    names = [f.name for f in fields(Level)]
    try:
        with np.load(path, allow_pickle=False) as arrays:
            count = len(arrays.files) // len(names)
            return [
                Level(*(arrays[f"{k}/{name}"] for name in names)) for k in range(count)
            ]
    except (KeyError, ValueError, OSError, EOFError, zipfile.BadZipFile):
        return None


def _make(mesh: Mesh) -> list[Level]:
    vertices, index = np.unique(
        np.asarray(mesh.vertices, np.float64), axis=0, return_inverse=True
    )
    faces = index.reshape(-1)[mesh.faces].reshape(-1, 3)
    uv = (
        np.zeros((len(faces), 3, 2))
        if mesh.uv is None
        else np.asarray(mesh.uv, np.float64)
    )
    faces, winding = turned_outwards(vertices, faces)
    uv = reversed_where(winding.flipped, uv)
    normals = corner_normals(vertices, faces).astype(np.float64)
    levels = [_level(vertices, faces, np.arange(len(faces)), normals, uv, 0.0)]
    for few, error in _coarser(vertices, faces):
        old = vertices[faces[few.source]]
        moved = uv[few.source] + _slip(old, few.vertices[few.faces], uv[few.source])
        levels.append(
            _level(few.vertices, few.faces, few.source, normals[few.source], moved, error)
        )
    return levels


def _coarser(
    vertices: np.ndarray, faces: np.ndarray
) -> Iterator[tuple[Simplified, float]]:
    """Simplified meshes, from fine to coarse, each with its ``error`` [m] as in `Level`."""
    if len(faces) < MIN_FACES:
        return
    steps = int(np.log(len(faces) / _FEWEST) / np.log(_STEP))
    targets = [int(len(faces) / _STEP**k) for k in range(1, steps + 1)]
    start = simplify(vertices, faces, MOST_COLLAPSED)
    # The error of ``simplify`` is bounded by how far it moved the corners of faces.
    off = 0.0
    if len(start.faces) < len(faces):
        offset = start.vertices[start.faces] - vertices[faces[start.source]]
        off = float(np.linalg.norm(offset, axis=2).max())
    before = len(faces)
    error = off
    for few, merged in collapse(start.vertices, start.faces, targets):
        # A level that saves little costs memory for nothing.
        if len(few.faces) > MOST_KEPT * before:
            continue
        before = len(few.faces)
        # A coarser level never claims less error than a finer one, or it would be taken first.
        error = max(error, off + _error(start.vertices, few, merged))
        yield Simplified(few.vertices, few.faces, start.source[few.source]), error


def _error(vertices: np.ndarray, few: Simplified, merged: np.ndarray) -> float:
    """Largest distance [m] of vertices (V, 3) to the faces adjacent to the vertex that each was merged into.

    ``merged`` (V,): index of that vertex in ``few``, or -1 for vertices of a removed component, whose distance to the
    nearest remaining vertex counts.
    """
    order = np.argsort(few.faces.ravel(), kind="stable")
    count = np.bincount(few.faces.ravel(), minlength=len(few.vertices))
    first = np.cumsum(count) - count
    known = np.flatnonzero(merged >= 0)
    nearest = np.full(len(known), np.inf)
    for k in range(int(count.max())):
        has = count[merged[known]] > k
        face = order[first[merged[known[has]]] + k] // 3
        off = distance_to_faces(vertices[known[has]], few.vertices[few.faces[face]])
        nearest[has] = np.minimum(nearest[has], off)
    gone = vertices[merged < 0]
    if len(gone):
        nearest = np.append(nearest, KDTree(few.vertices).query(gone)[0])
    return float(nearest.max())


def _slip(old: np.ndarray, new: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Change (f, 3, 2) of the texture coordinates ``uv`` (f, 3, 2) that keeps the texture in place on the surface.

    ``old``, ``new``: corners (f, 3, 3) of faces before and after simplification.
    """
    slope = _slopes(old, uv)
    size = np.linalg.norm(slope, axis=(1, 2))
    # The gradients of slivers are unreliable: limit them, else their corners get distant texture coordinates.
    slope *= np.minimum(1.0, 2.0 * np.median(size) / np.maximum(size, 1e-12))[
        :, None, None
    ]
    return np.einsum("fuc,fkc->fku", slope, new - old)


def _slopes(corners: np.ndarray, values: np.ndarray) -> np.ndarray:
    """In-plane gradients (F, n, 3) of values (F, 3, n) given at the corners (F, 3, 3) of faces; 0 on slivers."""
    a = corners[:, 1] - corners[:, 0]
    b = corners[:, 2] - corners[:, 0]
    aa = (a * a).sum(1)
    ab = (a * b).sum(1)
    bb = (b * b).sum(1)
    det = aa * bb - ab * ab
    # On slivers the gradient is 0 / 0; a constant value is the least wrong there.
    safe = det > 1e-8 * (aa * bb) + 1e-30
    inv = np.where(safe, 1.0 / np.where(safe, det, 1.0), 0.0)[:, None]
    to_a = (bb[:, None] * a - ab[:, None] * b) * inv
    to_b = (aa[:, None] * b - ab[:, None] * a) * inv
    da = values[:, 1] - values[:, 0]
    db = values[:, 2] - values[:, 0]
    return da[:, :, None] * to_a[:, None, :] + db[:, :, None] * to_b[:, None, :]


def _affine(corners: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Affine maps (F, n, 4) f32 of points that interpolate the values (F, 3, n) at the corners (F, 3, 3) of faces."""
    slope = _slopes(corners, values)
    middle = corners.mean(axis=1)
    mean = values.mean(axis=1)
    offset = mean - np.einsum("fnc,fc->fn", slope, middle)
    return np.concatenate([slope, offset[:, :, None]], axis=2).astype(np.float32)


def _level(
    vertices: np.ndarray,
    faces: np.ndarray,
    source: np.ndarray,
    normals: np.ndarray,
    uv: np.ndarray,
    error: float,
) -> Level:
    corners = np.asarray(vertices, np.float64)[faces]
    normal = _affine(corners, normals)
    flat = (normals == normals[:, :1]).all(axis=(1, 2))
    # Exactly constant on flat faces, where rounding of a gradient would shade a wall unevenly.
    normal[flat] = np.concatenate(
        [np.zeros((int(flat.sum()), 3, 3)), normals[flat, 0, :, None]], axis=2
    )
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    p = uv[:, 1] - uv[:, 0]
    q = uv[:, 2] - uv[:, 0]
    covered = np.abs(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    density = np.sqrt(covered / np.maximum(area, 1e-14))
    return Level(
        vertices.astype(np.float32),
        faces.astype(np.int32),
        source.astype(np.int32),
        normal,
        _affine(corners, uv),
        density.astype(np.float32),
        np.array([error]),
    )


def corner_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute unit normals per face corner.

    A normal is the mean over the faces at the vertex whose normals differ by less than the crease angle, weighted by
    their angles at the corner. Vertices at the same position count as one, so that texture seams and STL triangle soups
    are smooth.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3) indices into ``vertices``.

    Returns:
        (F, 3, 3) f32: face, corner, xyz.
    """
    points = np.asarray(vertices, np.float64)[faces]
    away = np.roll(points, -1, 1) - points
    back = np.roll(points, 1, 1) - points
    angle = np.arctan2(
        np.linalg.norm(np.cross(away, back), axis=2), (away * back).sum(2)
    ).reshape(-1, 1)
    area = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    size = np.linalg.norm(area, axis=1, keepdims=True)
    unit = np.where(size > 1e-14, area / np.maximum(size, 1e-14), (0.0, 0.0, 1.0))
    grid = np.round(
        np.asarray(vertices, np.float64)
        / max(float(np.ptp(vertices, axis=0).max()), 1e-9)
        # To a hundred-thousandth of the mesh: files repeat corners with rounding errors.
        * 1e5
    )
    weld = np.unique(grid.astype(np.int64), axis=0, return_inverse=True)[1].reshape(-1)
    corner = weld[faces].reshape(-1)
    order = np.argsort(corner, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(corner[order]) > 0])
    counts = np.diff(np.r_[starts, len(order)])
    result = np.repeat(unit[:, None], 3, axis=1).reshape(-1, 3)
    for count in np.unique(counts):
        rows = order[starts[counts == count][:, None] + np.arange(count)]
        own = unit[rows // 3]
        weight = own * angle[rows]
        for k in range(count):
            alike = np.einsum("nkc,nc->nk", own, own[:, k]) > CREASE
            total = np.einsum("nk,nkc->nc", alike, weight)
            length = np.linalg.norm(total, axis=1, keepdims=True)
            result[rows[:, k]] = np.where(
                length > 1e-14, total / np.maximum(length, 1e-14), own[:, k]
            )
    flat = np.abs(result.reshape(-1, 3, 3) - unit[:, None]).max((1, 2)) < 1e-5
    # Exactly the normal of the face, so that `_level` knows it as flat.
    result = np.where(flat[:, None, None], unit[:, None], result.reshape(-1, 3, 3))
    return result.astype(np.float32)
