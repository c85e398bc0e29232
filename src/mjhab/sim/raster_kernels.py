"""Compiled z-buffer kernels: instance poses, culling, near clipping, triangle filling.

View frame of every kernel: x right, y down, z forward (depth), so that a point (x, y, z) lands at column
``width / 2 + focal * x / z`` and row ``height / 2 + focal * y / z``; pixel centres lie at ``+ 0.5``.
Buffers hold inverse depth, which is linear on screen: 0 is background, larger is nearer.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

JIT: dict[str, Any] = {"nogil": True, "cache": True, "error_model": "numpy", "_nrt": False}
"""``_nrt`` off: the kernels make no arrays (see Scratch), and counting references to their arguments costs time."""
INLINE: dict[str, Any] = JIT | {"forceinline": True}
LOW_POLY = 64
"""Meshes up to this many faces (walls, boards) are drawn first: they hide whole rooms of finer meshes."""
EDGE_SLACK = 1e-7
"""Pixels this near outside an edge [px] count as inside, so that shared edges leave no holes."""
PARKED_BELOW = -25.0
"""Instances whose origin lies below this height [m] are parked pieces of other homes and are not drawn."""


class Geometry(NamedTuple):
    """Meshes for the kernels. N meshes.

    vertices (V, 3) f32; faces (F, 3) i32; mesh_faces, mesh_verts (N, 2) i32: first and count;
    mesh_box (N, 2, 3) f64: corners of the bounding box; instance_mesh (I,) i32.
    """

    vertices: np.ndarray
    faces: np.ndarray
    mesh_faces: np.ndarray
    mesh_verts: np.ndarray
    mesh_box: np.ndarray
    instance_mesh: np.ndarray


class Pose(NamedTuple):
    """World poses of the instances of one world: rot (I, 3, 3), pos (I, 3), scale (I, 3), all f64."""

    rot: np.ndarray
    pos: np.ndarray
    scale: np.ndarray


class Lens(NamedTuple):
    """A camera: pos (3,), mat (3, 3) f64 in MuJoCo convention; focal [px]; near [m]."""

    pos: np.ndarray
    mat: np.ndarray
    focal: float
    near: float


class Scratch(NamedTuple):
    """Room for ``draw``: points (6, largest mesh), keys (I,), to_view (3, 4), polygon (4, 3) f64;
    order (I,), rect (4,) i64."""

    points: np.ndarray
    keys: np.ndarray
    order: np.ndarray
    to_view: np.ndarray
    rect: np.ndarray
    polygon: np.ndarray


def make_scratch(geometry: Geometry) -> Scratch:
    """Scratch for one thread that draws ``geometry``."""
    count = len(geometry.instance_mesh)
    points = np.empty((6, int(geometry.mesh_verts[:, 1].max(initial=1))))
    order, rect = np.empty(count, np.int64), np.empty(4, np.int64)
    return Scratch(points, np.empty(count), order, np.empty((3, 4)), rect, np.empty((4, 3)))


@njit(**JIT)
def place_instances(instance_body, instance_pos, instance_mat, home_pos, home_mat, body_pos, body_mat, rot, pos):
    """Fill ``rot`` and ``pos`` (I, ...) with world poses from the home's (world) or the bodies' (others) poses."""
    for i in range(instance_body.shape[0]):
        b = instance_body[i]
        for r in range(3):
            if b == 0:
                pos[i, r] = home_pos[i, r]
                for c in range(3):
                    rot[i, r, c] = home_mat[i, r, c]
                continue
            pos[i, r] = body_pos[b, r]
            for c in range(3):
                pos[i, r] += body_mat[b, r, c] * instance_pos[i, c]
                rot[i, r, c] = (
                    body_mat[b, r, 0] * instance_mat[i, 0, c]
                    + body_mat[b, r, 1] * instance_mat[i, 1, c]
                    + body_mat[b, r, 2] * instance_mat[i, 2, c]
                )


@njit(**JIT)
def _to_view(pose, i, lens, view):
    """Write the map from mesh to view frame, (3, 4) with scale included, into ``view``."""
    for r in range(3):
        sign = 1.0 if r == 0 else -1.0
        m0, m1, m2 = sign * lens.mat[0, r], sign * lens.mat[1, r], sign * lens.mat[2, r]
        for c in range(3):
            view[r, c] = (m0 * pose.rot[i, 0, c] + m1 * pose.rot[i, 1, c] + m2 * pose.rot[i, 2, c]) * pose.scale[i, c]
        d0, d1, d2 = pose.pos[i, 0] - lens.pos[0], pose.pos[i, 1] - lens.pos[1], pose.pos[i, 2] - lens.pos[2]
        view[r, 3] = m0 * d0 + m1 * d1 + m2 * d2


@njit(**JIT)
def _bounds(view, boxes, mesh, lens, width, height, rect):
    """Nearest depth of a mesh's box and its pixel rectangle in ``rect``; -1 if it is out of sight.

    0 means that the box crosses the near plane; then ``rect`` is the whole image.
    """
    cx, cy = 0.5 * width, 0.5 * height
    left, right, top, bottom, behind = 0, 0, 0, 0, 0
    x0, x1, y0, y1, nearest = np.inf, -np.inf, np.inf, -np.inf, np.inf
    for k in range(8):
        p, q, s = boxes[mesh, k & 1, 0], boxes[mesh, (k >> 1) & 1, 1], boxes[mesh, k >> 2, 2]
        x = view[0, 0] * p + view[0, 1] * q + view[0, 2] * s + view[0, 3]
        y = view[1, 0] * p + view[1, 1] * q + view[1, 2] * s + view[1, 3]
        z = view[2, 0] * p + view[2, 1] * q + view[2, 2] * s + view[2, 3]
        left += lens.focal * x < -cx * z
        right += lens.focal * x > cx * z
        top += lens.focal * y < -cy * z
        bottom += lens.focal * y > cy * z
        behind += z < lens.near
        nearest = min(nearest, z)
        if z >= lens.near:
            u, v = cx + lens.focal * x / z, cy + lens.focal * y / z
            x0, x1, y0, y1 = min(x0, u), max(x1, u), min(y0, v), max(y1, v)
    if left == 8 or right == 8 or top == 8 or bottom == 8 or behind == 8:
        return -1.0
    if behind > 0:
        rect[0], rect[1], rect[2], rect[3] = 0, width, 0, height
        return 0.0
    rect[0], rect[1] = int(max(x0, 0.0)), int(min(x1 + 1.0, width))
    rect[2], rect[3] = int(max(y0, 0.0)), int(min(y1 + 1.0, height))
    return nearest


@njit(**JIT)
def _hidden(inverse, rect, nearest):
    """True if everything drawn inside the rectangle is nearer than ``nearest`` [m]."""
    limit = 1.0 / nearest
    for y in range(rect[2], rect[3]):
        for x in range(rect[0], rect[1]):
            if inverse[y, x] < limit:
                return False
    return True


@njit(**INLINE)
def _fill_small(inverse, ids, tag, x0, y0, x1, y1, x2, y2, w0, gx, gy, left, right, top, bottom):
    """Fill a triangle of a few pixels by testing every pixel of its box."""
    for row in range(top, bottom + 1):
        y = row + 0.5
        for col in range(left, right + 1):
            x = col + 0.5
            if (
                (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) >= -EDGE_SLACK
                and (x2 - x1) * (y - y1) - (y2 - y1) * (x - x1) >= -EDGE_SLACK
                and (x0 - x2) * (y - y2) - (y0 - y2) * (x - x2) >= -EDGE_SLACK
            ):
                w = np.float32(w0 + gx * (x - x0) + gy * (y - y0))
                if w > inverse[row, col]:
                    inverse[row, col] = w
                    ids[row, col] = tag


@njit(**INLINE)
def _clip_span(y, xa, ya, xb, yb, low, high):
    """Cut the span [low, high] of a row at height ``y`` with the inside of one edge."""
    rise = yb - ya
    if rise == 0.0:
        if (xb - xa) * (y - ya) < 0.0:
            high = -1.0
    else:
        x = xa + (xb - xa) * (y - ya) / rise
        if rise > 0.0:
            high = min(high, x + EDGE_SLACK)
        else:
            low = max(low, x - EDGE_SLACK)
    return low, high


@njit(**INLINE)
def _fill(inverse, ids, tag, x0, y0, w0, x1, y1, w1, x2, y2, w2, keep):
    """Fill one projected triangle. ``keep`` 0: both sides, 1 or -1: the side with this sign of area."""
    height, width = inverse.shape
    left = max(np.ceil(min(x0, x1, x2) - 0.5 - EDGE_SLACK), 0.0)
    right = min(np.floor(max(x0, x1, x2) - 0.5 + EDGE_SLACK), width - 1.0)
    top = max(np.ceil(min(y0, y1, y2) - 0.5 - EDGE_SLACK), 0.0)
    bottom = min(np.floor(max(y0, y1, y2) - 0.5 + EDGE_SLACK), height - 1.0)
    if left > right or top > bottom:
        return
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    if area == 0.0 or area * keep < 0.0:
        return
    gx = ((w1 - w0) * (y2 - y0) - (w2 - w0) * (y1 - y0)) / area
    gy = ((x1 - x0) * (w2 - w0) - (x2 - x0) * (w1 - w0)) / area
    if area < 0.0:
        x1, y1, x2, y2 = x2, y2, x1, y1
    if (right - left) <= 3.0 and (bottom - top) <= 3.0:
        _fill_small(inverse, ids, tag, x0, y0, x1, y1, x2, y2, w0, gx, gy, int(left), int(right), int(top), int(bottom))
        return
    for row in range(int(top), int(bottom) + 1):
        y = row + 0.5
        low, high = left + 0.5, right + 0.5
        low, high = _clip_span(y, x0, y0, x1, y1, low, high)
        low, high = _clip_span(y, x1, y1, x2, y2, low, high)
        low, high = _clip_span(y, x2, y2, x0, y0, low, high)
        if low > high:
            continue
        start = w0 + gy * (y - y0) + gx * (0.5 - x0)
        for col in range(int(np.ceil(low - 0.5)), int(np.floor(high - 0.5)) + 1):
            w = np.float32(start + gx * col)
            if w > inverse[row, col]:
                inverse[row, col] = w
                ids[row, col] = tag


@njit(**JIT)
def _fill_clipped(inverse, ids, tag, points, out, a, b, c, lens, keep):
    """Cut a triangle that crosses the near plane and fill what is left (three or four corners).

    ``out`` (4, 3) is scratch.
    """
    height, width = inverse.shape
    count = 0
    for k in range(3):
        p = a if k == 0 else (b if k == 1 else c)
        q = b if k == 0 else (c if k == 1 else a)
        zp, zq = points[2, p], points[2, q]
        if zp >= lens.near:
            for r in range(3):
                out[count, r] = points[r, p]
            count += 1
        if (zp >= lens.near) != (zq >= lens.near):
            t = (lens.near - zp) / (zq - zp)
            for r in range(3):
                out[count, r] = points[r, p] + t * (points[r, q] - points[r, p])
            count += 1
    for k in range(count):
        w = 1.0 / out[k, 2]
        out[k, 0] = 0.5 * width + lens.focal * out[k, 0] * w
        out[k, 1] = 0.5 * height + lens.focal * out[k, 1] * w
        out[k, 2] = w
    for k in range(2, count):
        _fill(
            inverse, ids, tag, out[0, 0], out[0, 1], out[0, 2], out[k - 1, 0], out[k - 1, 1], out[k - 1, 2],
            out[k, 0], out[k, 1], out[k, 2], keep,
        )  # fmt: skip


@njit(**JIT)
def _project(vertices, first, count, view, lens, width, height, points):
    """Fill ``points`` (6, >= count): view x, y, z, then column, row and inverse depth."""
    cx, cy = 0.5 * width, 0.5 * height
    for k in range(count):
        p, q, s = vertices[first + k, 0], vertices[first + k, 1], vertices[first + k, 2]
        x = view[0, 0] * p + view[0, 1] * q + view[0, 2] * s + view[0, 3]
        y = view[1, 0] * p + view[1, 1] * q + view[1, 2] * s + view[1, 3]
        z = view[2, 0] * p + view[2, 1] * q + view[2, 2] * s + view[2, 3]
        w = 1.0 / z
        points[0, k], points[1, k], points[2, k] = x, y, z
        points[3, k], points[4, k], points[5, k] = cx + lens.focal * x * w, cy + lens.focal * y * w, w


@njit(**JIT)
def _draw_instance(geometry, i, lens, nearest, keep, inverse, ids, scratch):
    """Project and fill all faces of one instance."""
    mesh = geometry.instance_mesh[i]
    first, start = geometry.mesh_verts[mesh, 0], geometry.mesh_faces[mesh, 0]
    height, width = inverse.shape
    points = scratch.points
    _project(geometry.vertices, first, geometry.mesh_verts[mesh, 1], scratch.to_view, lens, width, height, points)
    whole = nearest > 0.0
    for face in range(start, start + geometry.mesh_faces[mesh, 1]):
        a = geometry.faces[face, 0] - first
        b = geometry.faces[face, 1] - first
        c = geometry.faces[face, 2] - first
        tag = (np.int64(i) << 32) | face
        if not whole:
            near = (points[2, a] < lens.near) + (points[2, b] < lens.near) + (points[2, c] < lens.near)
            if near == 3:
                continue
            if near > 0:
                _fill_clipped(inverse, ids, tag, points, scratch.polygon, a, b, c, lens, keep)
                continue
        _fill(
            inverse, ids, tag,
            points[3, a], points[4, a], points[5, a],
            points[3, b], points[4, b], points[5, b],
            points[3, c], points[4, c], points[5, c], keep,
        )  # fmt: skip


@njit(**JIT)
def _sort(keys, order, count):
    """Shell sort ``order[:count]`` by ``keys``."""
    gap = count // 2
    while gap > 0:
        for i in range(gap, count):
            key, item, j = keys[i], order[i], i
            while j >= gap and keys[j - gap] > key:
                keys[j], order[j] = keys[j - gap], order[j - gap]
                j -= gap
            keys[j], order[j] = key, item
        gap //= 2


@njit(**JIT)
def draw(geometry, which, pose, lens, cull, inverse, ids, scratch):
    """Draw the instances ``which`` (K,) i32 into ``inverse`` (h, w) f32 and ``ids`` (h, w) i64.

    The buffers are added to, not cleared. An id is ``instance << 32 | face``.
    ``cull``: drop faces seen from behind.
    """
    height, width = inverse.shape
    keys, order, view, rect = scratch.keys, scratch.order, scratch.to_view, scratch.rect
    count = 0
    for n in range(which.shape[0]):
        i = which[n]
        size = pose.scale[i, 0] * pose.scale[i, 1] * pose.scale[i, 2]
        if size == 0.0 or pose.pos[i, 2] < PARKED_BELOW:
            continue
        mesh = geometry.instance_mesh[i]
        _to_view(pose, i, lens, view)
        nearest = _bounds(view, geometry.mesh_box, mesh, lens, width, height, rect)
        if nearest >= 0.0:
            keys[count] = nearest - (1e6 if geometry.mesh_faces[mesh, 1] <= LOW_POLY else 0.0)
            order[count] = i
            count += 1
    _sort(keys, order, count)
    for k in range(count):
        i = order[k]
        mesh = geometry.instance_mesh[i]
        _to_view(pose, i, lens, view)
        nearest = _bounds(view, geometry.mesh_box, mesh, lens, width, height, rect)
        if nearest > 0.0 and geometry.mesh_faces[mesh, 1] > LOW_POLY and _hidden(inverse, rect, nearest):
            continue
        keep = 0.0
        if cull:
            keep = -1.0 if pose.scale[i, 0] * pose.scale[i, 1] * pose.scale[i, 2] > 0.0 else 1.0
        _draw_instance(geometry, i, lens, nearest, keep, inverse, ids, scratch)


@njit(**JIT)
def read_depth(inverse, out):
    """Write planar depth [m] (0 background) of ``inverse`` (h, w) into ``out`` (h, w) f32."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            w = inverse[y, x]
            out[y, x] = 1.0 / w if w > 0.0 else 0.0


@njit(**JIT)
def read_segments(inverse, ids, instance_seg, out):
    """Write the segment id (0 background) of every pixel into ``out`` (h, w) i32."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[y, x] = instance_seg[ids[y, x] >> 32] if inverse[y, x] > 0.0 else 0
