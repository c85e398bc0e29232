"""Kernels that draw one mesh: choice of the level of detail, back-face culling, projection and rasterisation."""

from __future__ import annotations

import numpy as np

from mjhab.render.jit import inline, kernel
from mjhab.render.raster.arrays import FACE_BITS
from mjhab.render.raster.fill import fill, fill_clipped

PLANE_SLACK = 1e-5
"""Tolerance of back-face culling for the float32 planes of faces, relative to the camera's distance from the origin of
the mesh: a camera this far behind a plane still counts as in front of it."""
CELL_SLACK = 1e-6
"""A vertex this near to the column or row of a pixel centre [px] has no cell there; more than `fill.EDGE_SLACK`."""
_COLUMN = 0xFFFF
_ROW = 0xFFFF << 16
_NO_CELL = 0x8000
"""Cells of columns and rows in one number: 15 bits of each, and a bit that tells that there is none."""


@inline
def _camera_in_mesh(scratch, i, lens, axis):
    """Coordinate of the camera along an axis of an instance [m], not divided by the instance's scale."""
    rot = scratch.rot
    return (
        rot[i, 0, axis] * (lens.pos[0] - scratch.pos[i, 0])
        + rot[i, 1, axis] * (lens.pos[1] - scratch.pos[i, 1])
        + rot[i, 2, axis] * (lens.pos[2] - scratch.pos[i, 2])
    )


@kernel
def _distance(geometry, mesh, scratch, i, lens):
    """Distance [m] from the camera to the oriented bounding box of an instance; 0 inside."""
    total = 0.0
    for axis in range(3):
        scale = scratch.scale[i, axis]
        off = abs(
            _camera_in_mesh(scratch, i, lens, axis)
            - geometry.mesh_middle[mesh, axis] * scale
        )
        out = max(off - abs(geometry.mesh_half[mesh, axis] * scale), 0.0)
        total += out * out
    return np.sqrt(total)


@kernel
def fitting_level(geometry, mesh, scratch, i, lens, nearest):
    """The coarsest level of detail whose projected error is within the camera's ``level_error``.

    ``nearest`` is the smallest depth [m] of the instance, 0 if it crosses the near plane.
    """
    scale = scratch.scale
    if geometry.mesh_coarser[mesh] < 0:
        return mesh
    grow = max(abs(scale[i, 0]), abs(scale[i, 1]), abs(scale[i, 2]))
    # A box that reaches behind the camera may still be far away, to the side of the view axis.
    depth = max(nearest, 0.5 * _distance(geometry, mesh, scratch, i, lens))
    limit = lens.level_error / lens.focal * depth
    while True:
        coarser = geometry.mesh_coarser[mesh]
        if coarser < 0 or geometry.mesh_error[coarser] * grow > limit:
            return mesh
        mesh = coarser


@kernel
def _find_front(geometry, i, mesh, lens, scratch):
    """Fill ``front`` with the faces of a mesh that may face the camera; returns their number.

    Faces are counted from the mesh's first.
    """
    x = np.float32(_camera_in_mesh(scratch, i, lens, 0) / scratch.scale[i, 0])
    y = np.float32(_camera_in_mesh(scratch, i, lens, 1) / scratch.scale[i, 1])
    z = np.float32(_camera_in_mesh(scratch, i, lens, 2) / scratch.scale[i, 2])
    least = np.float32(-PLANE_SLACK * (1.0 + abs(x) + abs(y) + abs(z)))
    start = np.uint64(geometry.mesh_faces[mesh, 0])
    planes = geometry.planes
    front = scratch.front
    inside = scratch.faces_inside
    count = np.uint64(geometry.mesh_faces[mesh, 1])
    for k in range(count):
        at = start + k
        inside[k] = (
            planes[0, at] * x + planes[1, at] * y + planes[2, at] * z + planes[3, at]
            > least
        )
    found = np.uint64(0)
    for k in range(count):
        front[found] = k
        found += np.uint64(inside[k])
    return found


@kernel
def _project(geometry, mesh, k, lens, width, height, scratch):
    """Fill ``points`` (6, at least the number of vertices) with every vertex of a mesh.

    Rows: x, y, z in the view frame [m] by ``to_view[k]``, then column, row [px] and inverse depth [1/m].
    """
    first = geometry.mesh_verts[mesh, 0]
    count = geometry.mesh_verts[mesh, 1]
    points = scratch.points
    view = scratch.to_view
    cx = 0.5 * width
    cy = 0.5 * height
    focal = lens.focal
    a0 = view[k, 0, 0]
    a1 = view[k, 0, 1]
    a2 = view[k, 0, 2]
    a3 = view[k, 0, 3]
    b0 = view[k, 1, 0]
    b1 = view[k, 1, 1]
    b2 = view[k, 1, 2]
    b3 = view[k, 1, 3]
    c0 = view[k, 2, 0]
    c1 = view[k, 2, 1]
    c2 = view[k, 2, 2]
    c3 = view[k, 2, 3]
    for n in range(np.uint64(count)):
        at = np.uint64(first) + n
        p = geometry.vertices[0, at]
        q = geometry.vertices[1, at]
        s = geometry.vertices[2, at]
        x = a0 * p + a1 * q + a2 * s + a3
        y = b0 * p + b1 * q + b2 * s + b3
        z = c0 * p + c1 * q + c2 * s + c3
        w = 1.0 / z
        points[0, n] = x
        points[1, n] = y
        points[2, n] = z
        points[3, n] = cx + focal * x * w
        points[4, n] = cy + focal * y * w
        points[5, n] = w


@inline
def _cell(at, size):
    """Number of pixel centres along an axis before the place ``at`` [px], 15 bits, and `_NO_CELL` if it is at one."""
    place = min(max(at + 0.5, 0.0), size + 0.5)
    before = np.int32(place - CELL_SLACK)
    return before if before == np.int32(place + CELL_SLACK) else np.int32(_NO_CELL)


@kernel
def _drop_small(geometry, mesh, found, width, height, scratch):
    """Keep of the first ``found`` faces in ``front`` those that may cover a pixel centre; returns their number.

    A triangle covers none if all its vertices lie between the same two columns, or rows, of pixel centres.
    """
    cells = scratch.cells
    points = scratch.points
    for n in range(np.uint64(geometry.mesh_verts[mesh, 1])):
        cells[n] = _cell(points[3, n], width) | (_cell(points[4, n], height) << 16)
    faces = geometry.faces
    front = scratch.front
    start = np.uint64(geometry.mesh_faces[mesh, 0])
    kept = np.uint64(0)
    for n in range(np.uint64(found)):
        number = front[n]
        face = start + np.uint64(number)
        a = cells[np.uint64(faces[face, 0])]
        b = cells[np.uint64(faces[face, 1])]
        c = cells[np.uint64(faces[face, 2])]
        apart = (a ^ b) | (a ^ c) | ((a | b | c) & (_NO_CELL | _NO_CELL << 16))
        front[kept] = number
        kept += np.uint64(((apart & _COLUMN) != 0) & ((apart & _ROW) != 0))
    return kept


@kernel
def draw_mesh(geometry, i, mesh, k, lens, cull, inverse, ids, scratch):
    """Project and rasterise the faces of instance ``i``, drawn as the level ``mesh`` with the map ``to_view[k]``."""
    height, width = inverse.shape
    points = scratch.points
    near = lens.near
    faces = geometry.faces
    scale = scratch.scale
    start = np.uint64(geometry.mesh_faces[mesh, 0])
    keep = 0.0
    count = np.uint64(geometry.mesh_faces[mesh, 1])
    if cull:
        keep = -1.0 if scale[i, 0] * scale[i, 1] * scale[i, 2] > 0.0 else 1.0
        count = _find_front(geometry, i, mesh, lens, scratch)
    if count == 0:
        return
    _project(geometry, mesh, k, lens, width, height, scratch)
    whole = scratch.nearest[k] > 0.0
    if whole and cull and max(width, height) < _NO_CELL:
        count = _drop_small(geometry, mesh, count, width, height, scratch)
    base = i << FACE_BITS
    for n in range(count):
        number = np.uint64(scratch.front[n]) if cull else n
        face = start + number
        a = np.uint64(faces[face, 0])
        b = np.uint64(faces[face, 1])
        c = np.uint64(faces[face, 2])
        tag = np.int32(base | np.int64(number))
        if not whole:
            behind = (points[2, a] < near) + (points[2, b] < near) + (points[2, c] < near)
            if behind == 3:
                continue
            if behind > 0:
                fill_clipped(
                    inverse,
                    ids,
                    tag,
                    points,
                    scratch.polygon,
                    a,
                    b,
                    c,
                    lens.focal,
                    near,
                    keep,
                )
                continue
        fill(
            inverse,
            ids,
            tag,
            points[3, a],
            points[4, a],
            points[5, a],
            points[3, b],
            points[4, b],
            points[5, b],
            points[3, c],
            points[4, c],
            points[5, c],
            keep,
        )
