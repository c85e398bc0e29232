"""Compiled z-buffer kernels: instance poses, culling, levels of detail, drawing of instances.

View frame of every kernel: x right, y down, z forward (depth), so that a point (x, y, z) lands at column
``width / 2 + focal * x / z`` and row ``height / 2 + focal * y / z``; pixel centres lie at ``+ 0.5``.
Buffers hold inverse depth, which is linear on screen: 0 is background, larger is nearer.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.render.raster.fill import fill, fill_clipped
from mjhab.render.raster.jit import inline, kernel

LOW_POLY = 64
"""Meshes up to this many faces (walls, boards) are drawn first: they hide whole rooms of finer meshes."""
FACE_BITS = 18
"""An id of a pixel is ``instance << FACE_BITS | face of the drawn mesh``."""
PARKED_BELOW = -25.0
"""Instances whose origin lies below this height [m] are parked pieces of other homes and are not drawn."""
LEVEL_ERROR = 0.4
"""A coarser mesh is drawn where none of its points is off by more than this [px]."""


class Geometry(NamedTuple):
    """Meshes for the kernels: every level of detail is a mesh of its own. N meshes.

    vertices (3, V) f32; faces (F, 3) i32, counted from the mesh's first vertex; mesh_faces, mesh_verts (N, 2) i32:
    first and count; mesh_box (N, 2, 3) f64: corners of the bounding box; mesh_ball (N, 4) f64: centre and radius;
    mesh_coarser (N,) i32: the next coarser level, -1 none; mesh_error (N,) f64: how far the level is off [m].
    """

    vertices: np.ndarray
    faces: np.ndarray
    mesh_faces: np.ndarray
    mesh_verts: np.ndarray
    mesh_box: np.ndarray
    mesh_ball: np.ndarray
    mesh_coarser: np.ndarray
    mesh_error: np.ndarray


class Placing(NamedTuple):
    """Where the instances stand (arrays of RenderScene), and which are there in a home.

    ``present`` (P,) i32: instances of home h at ``present_start[h] : present_start[h + 1]``.
    """

    mesh: np.ndarray
    body: np.ndarray
    pos: np.ndarray
    mat: np.ndarray
    home_pos: np.ndarray
    home_mat: np.ndarray
    home_scale: np.ndarray
    present: np.ndarray
    present_start: np.ndarray


class Lens(NamedTuple):
    """A camera: pos (3,), mat (3, 3) f64 in MuJoCo convention; focal [px]; near [m]."""

    pos: np.ndarray
    mat: np.ndarray
    focal: float
    near: float


class Scratch(NamedTuple):
    """One thread's room, made by ``make_scratch``. I instances.

    rot (I, 3, 3), pos (I, 3), scale (I, 3) f64: world poses of the current world; points (6, largest mesh) f64;
    keys (I,) f64, order (I,) i64: drawing order; drawn (I,) i32: mesh drawn for each instance of the current image;
    to_view (3, 4), rect (4,), polygon (4, 3): one instance or triangle.
    """

    rot: np.ndarray
    pos: np.ndarray
    scale: np.ndarray
    points: np.ndarray
    keys: np.ndarray
    order: np.ndarray
    drawn: np.ndarray
    to_view: np.ndarray
    rect: np.ndarray
    polygon: np.ndarray


def make_scratch(geometry: Geometry, instances: int) -> Scratch:
    """Scratch for one thread that draws ``geometry``."""
    points = np.empty((6, int(geometry.mesh_verts[:, 1].max(initial=1))))
    return Scratch(
        np.empty((instances, 3, 3)),
        np.empty((instances, 3)),
        np.empty((instances, 3)),
        points,
        np.empty(instances),
        np.empty(instances, np.int64),
        np.zeros(instances, np.int32),
        np.empty((3, 4)),
        np.empty(4, np.int64),
        np.empty((4, 3)),
    )


@kernel
def place_instances(placing, home, body_pos, body_mat, scratch):
    """World poses of the instances in a home into the scratch: from the home, or from their bodies' poses."""
    pos = scratch.pos
    rot = scratch.rot
    scale = scratch.scale
    for k in range(placing.present_start[home], placing.present_start[home + 1]):
        i = placing.present[k]
        b = placing.body[i]
        for r in range(3):
            scale[i, r] = placing.home_scale[home, i, r]
            if b == 0:
                pos[i, r] = placing.home_pos[home, i, r]
                for c in range(3):
                    rot[i, r, c] = placing.home_mat[home, i, r, c]
                continue
            pos[i, r] = body_pos[b, r]
            for c in range(3):
                pos[i, r] += body_mat[b, r, c] * placing.pos[i, c]
                rot[i, r, c] = (
                    body_mat[b, r, 0] * placing.mat[i, 0, c]
                    + body_mat[b, r, 1] * placing.mat[i, 1, c]
                    + body_mat[b, r, 2] * placing.mat[i, 2, c]
                )


@kernel
def _to_view(scratch, i, lens):
    """Write the map from mesh to view frame, (3, 4) with scale included."""
    view = scratch.to_view
    rot = scratch.rot
    scale = scratch.scale
    for r in range(3):
        sign = 1.0 if r == 0 else -1.0
        m0 = sign * lens.mat[0, r]
        m1 = sign * lens.mat[1, r]
        m2 = sign * lens.mat[2, r]
        for c in range(3):
            view[r, c] = (m0 * rot[i, 0, c] + m1 * rot[i, 1, c] + m2 * rot[i, 2, c]) * scale[i, c]
        d0 = scratch.pos[i, 0] - lens.pos[0]
        d1 = scratch.pos[i, 1] - lens.pos[1]
        d2 = scratch.pos[i, 2] - lens.pos[2]
        view[r, 3] = m0 * d0 + m1 * d1 + m2 * d2


@inline
def _ball_in_sight(geometry, mesh, scratch, i, lens, width, height):
    """False if the ball around an instance is out of the picture for sure."""
    s = scratch.scale
    ball = geometry.mesh_ball
    rot = scratch.rot
    mat = lens.mat
    radius = ball[mesh, 3] * max(abs(s[i, 0]), abs(s[i, 1]), abs(s[i, 2]))
    p = ball[mesh, 0] * s[i, 0]
    q = ball[mesh, 1] * s[i, 1]
    u = ball[mesh, 2] * s[i, 2]
    dx = scratch.pos[i, 0] - lens.pos[0] + rot[i, 0, 0] * p + rot[i, 0, 1] * q + rot[i, 0, 2] * u
    dy = scratch.pos[i, 1] - lens.pos[1] + rot[i, 1, 0] * p + rot[i, 1, 1] * q + rot[i, 1, 2] * u
    dz = scratch.pos[i, 2] - lens.pos[2] + rot[i, 2, 0] * p + rot[i, 2, 1] * q + rot[i, 2, 2] * u
    x = abs(mat[0, 0] * dx + mat[1, 0] * dy + mat[2, 0] * dz)
    y = abs(mat[0, 1] * dx + mat[1, 1] * dy + mat[2, 1] * dz)
    z = -(mat[0, 2] * dx + mat[1, 2] * dy + mat[2, 2] * dz)
    f = lens.focal
    cx = 0.5 * width
    cy = 0.5 * height
    if z < -radius or x * f - z * cx > radius * np.sqrt(f * f + cx * cx):
        return False
    return y * f - z * cy <= radius * np.sqrt(f * f + cy * cy)


@kernel
def _bounds(view, boxes, mesh, lens, width, height, rect):
    """Nearest depth of a mesh's box and its pixel rectangle in ``rect``; -1 if it is out of sight.

    0 means that the box crosses the near plane; then ``rect`` is the whole image.
    """
    cx = 0.5 * width
    cy = 0.5 * height
    left = 0
    right = 0
    top = 0
    bottom = 0
    behind = 0
    x0 = np.inf
    x1 = -np.inf
    y0 = np.inf
    y1 = -np.inf
    nearest = np.inf
    for k in range(8):
        p = boxes[mesh, k & 1, 0]
        q = boxes[mesh, (k >> 1) & 1, 1]
        s = boxes[mesh, k >> 2, 2]
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
            u = cx + lens.focal * x / z
            v = cy + lens.focal * y / z
            x0 = min(x0, u)
            x1 = max(x1, u)
            y0 = min(y0, v)
            y1 = max(y1, v)
    if left == 8 or right == 8 or top == 8 or bottom == 8 or behind == 8:
        return -1.0
    if behind > 0:
        rect[0] = 0
        rect[1] = width
        rect[2] = 0
        rect[3] = height
        return 0.0
    rect[0] = int(max(x0, 0.0))
    rect[1] = int(min(x1 + 1.0, width))
    rect[2] = int(max(y0, 0.0))
    rect[3] = int(min(y1 + 1.0, height))
    return nearest


@kernel
def _hidden(inverse, rect, nearest):
    """True if everything drawn inside the rectangle is nearer than ``nearest`` [m]."""
    limit = 1.0 / nearest
    for y in range(rect[2], rect[3]):
        for x in range(rect[0], rect[1]):
            if inverse[y, x] < limit:
                return False
    return True


@kernel
def _distance(geometry, mesh, scratch, i, lens):
    """Distance [m] from the camera to the box of an instance."""
    rot = scratch.rot
    total = 0.0
    d0 = lens.pos[0] - scratch.pos[i, 0]
    d1 = lens.pos[1] - scratch.pos[i, 1]
    d2 = lens.pos[2] - scratch.pos[i, 2]
    for k in range(3):
        x = rot[i, 0, k] * d0 + rot[i, 1, k] * d1 + rot[i, 2, k] * d2
        a = geometry.mesh_box[mesh, 0, k] * scratch.scale[i, k]
        b = geometry.mesh_box[mesh, 1, k] * scratch.scale[i, k]
        out = max(min(a, b) - x, x - max(a, b), 0.0)
        total += out * out
    return np.sqrt(total)


@kernel
def _level(geometry, mesh, scratch, i, lens, nearest):
    """The coarsest level of a mesh that looks right; ``nearest``: its smallest depth [m]."""
    scale = scratch.scale
    if geometry.mesh_coarser[mesh] < 0:
        return mesh
    grow = max(abs(scale[i, 0]), abs(scale[i, 1]), abs(scale[i, 2]))
    # A box that reaches behind the camera can still be all at its side.
    limit = (
        LEVEL_ERROR / lens.focal * max(nearest, 0.5 * _distance(geometry, mesh, scratch, i, lens))
    )
    while True:
        coarser = geometry.mesh_coarser[mesh]
        if coarser < 0 or geometry.mesh_error[coarser] * grow > limit:
            return mesh
        mesh = coarser


@kernel
def _project(geometry, mesh, view, lens, width, height, points):
    """Fill ``points`` (6, >= count): view x, y, z, then column, row and inverse depth."""
    first = geometry.mesh_verts[mesh, 0]
    count = geometry.mesh_verts[mesh, 1]
    cx = 0.5 * width
    cy = 0.5 * height
    focal = lens.focal
    a0 = view[0, 0]
    a1 = view[0, 1]
    a2 = view[0, 2]
    a3 = view[0, 3]
    b0 = view[1, 0]
    b1 = view[1, 1]
    b2 = view[1, 2]
    b3 = view[1, 3]
    c0 = view[2, 0]
    c1 = view[2, 1]
    c2 = view[2, 2]
    c3 = view[2, 3]
    for k in range(np.uint64(count)):
        at = np.uint64(first) + k
        p = geometry.vertices[0, at]
        q = geometry.vertices[1, at]
        s = geometry.vertices[2, at]
        x = a0 * p + a1 * q + a2 * s + a3
        y = b0 * p + b1 * q + b2 * s + b3
        z = c0 * p + c1 * q + c2 * s + c3
        w = 1.0 / z
        points[0, k] = x
        points[1, k] = y
        points[2, k] = z
        points[3, k] = cx + focal * x * w
        points[4, k] = cy + focal * y * w
        points[5, k] = w


@kernel
def _draw_instance(geometry, i, mesh, lens, nearest, keep, inverse, ids, scratch):
    """Project and fill all faces of one instance."""
    start = geometry.mesh_faces[mesh, 0]
    height, width = inverse.shape
    points = scratch.points
    near = lens.near
    faces = geometry.faces
    _project(geometry, mesh, scratch.to_view, lens, width, height, points)
    whole = nearest > 0.0
    base = i << FACE_BITS
    for k in range(geometry.mesh_faces[mesh, 1]):
        face = np.uint64(start + k)
        a = np.uint64(faces[face, 0])
        b = np.uint64(faces[face, 1])
        c = np.uint64(faces[face, 2])
        tag = np.int32(base | k)
        if not whole:
            behind = (points[2, a] < near) + (points[2, b] < near) + (points[2, c] < near)
            if behind == 3:
                continue
            if behind > 0:
                fill_clipped(
                    inverse, ids, tag, points, scratch.polygon, a, b, c, lens.focal, near, keep
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


@kernel
def _sort(keys, order, count):
    """Shell sort ``order[:count]`` by ``keys``."""
    gap = count // 2
    while gap > 0:
        for i in range(gap, count):
            key = keys[i]
            item = order[i]
            j = i
            while j >= gap and keys[j - gap] > key:
                keys[j], order[j] = keys[j - gap], order[j - gap]
                j -= gap
            keys[j] = key
            order[j] = item
        gap //= 2


@kernel
def draw(geometry, placing, home, which, lens, cull, inverse, ids, scratch):
    """Draw the placed instances of a home into ``inverse`` (h, w) f32 and ``ids`` (h, w) i32.

    The buffers are added to, not cleared. ``which`` 0: all; 1: those that stand in the world; 2: those on bodies.
    ``cull``: drop faces seen from behind.
    """
    height, width = inverse.shape
    keys = scratch.keys
    order = scratch.order
    view = scratch.to_view
    rect = scratch.rect
    scale = scratch.scale
    count = 0
    for k in range(placing.present_start[home], placing.present_start[home + 1]):
        i = placing.present[k]
        if (which == 1 and placing.body[i] != 0) or (which == 2 and placing.body[i] == 0):
            continue
        mesh = placing.mesh[i]
        if scratch.pos[i, 2] < PARKED_BELOW or not _ball_in_sight(
            geometry, mesh, scratch, i, lens, width, height
        ):
            continue
        _to_view(scratch, i, lens)
        nearest = _bounds(view, geometry.mesh_box, mesh, lens, width, height, rect)
        if nearest >= 0.0:
            keys[count] = nearest - (1e6 if geometry.mesh_faces[mesh, 1] <= LOW_POLY else 0.0)
            order[count] = i
            count += 1
    _sort(keys, order, count)
    for k in range(count):
        i = order[k]
        mesh = placing.mesh[i]
        _to_view(scratch, i, lens)
        nearest = _bounds(view, geometry.mesh_box, mesh, lens, width, height, rect)
        if (
            nearest > 0.0
            and geometry.mesh_faces[mesh, 1] > LOW_POLY
            and _hidden(inverse, rect, nearest)
        ):
            continue
        keep = 0.0
        if cull:
            keep = -1.0 if scale[i, 0] * scale[i, 1] * scale[i, 2] > 0.0 else 1.0
        mesh = _level(geometry, mesh, scratch, i, lens, nearest)
        scratch.drawn[i] = mesh
        _draw_instance(geometry, i, mesh, lens, nearest, keep, inverse, ids, scratch)


@kernel
def read_depth(inverse, out):
    """Write planar depth [m] (0 background) of ``inverse`` (h, w) into ``out`` (h, w) f32."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            w = inverse[y, x]
            out[y, x] = np.float32(1.0) / w if w > np.float32(0.0) else np.float32(0.0)


@kernel
def read_segments(inverse, ids, instance_seg, out):
    """Write the segment id (0 background) of every pixel into ``out`` (h, w) i32."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[y, x] = instance_seg[ids[y, x] >> FACE_BITS] if inverse[y, x] > 0.0 else 0
