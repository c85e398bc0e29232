"""Compiled search for the instances that a camera can see: balls, then boxes, then what is in front of them.

Nothing that covers the centre of a pixel and is nearest there is left out: pictures are the same as without.
"""

from __future__ import annotations

import numpy as np

from mjhab.render.raster.arrays import ORDER_BUCKETS, PARKED_BELOW
from mjhab.render.raster.jit import inline, kernel

BALL_SLACK = 1e-3
"""Balls are tested in float32: this much [m] larger they hold what is in them for sure."""
RECT_SLACK = 1e-6
"""Pixels whose centres are this near outside a rectangle [px] count as inside."""
BUCKETS_PER_M = 12.0
"""Buckets of drawing order per depth [1/m]."""
SIGNS = np.array([[-1.0 if k >> axis & 1 == 0 else 1.0 for k in range(8)] for axis in range(3)])
"""Corner k of a box lies on the upper side of axis a where bit a of k is set."""


@kernel
def place_instances(geometry, placing, home, body_pos, body_mat, scratch):
    """World poses of the instances on bodies, and balls around all instances in a home, into the scratch."""
    pos = scratch.pos
    rot = scratch.rot
    scale = scratch.scale
    ball = scratch.ball
    start = placing.start[home]
    for r in range(4):
        for k in range(start, placing.moving[home]):
            ball[r, k - start] = placing.ball[r, k]
    for k in range(placing.moving[home], placing.start[home + 1]):
        i = placing.present[k]
        b = placing.body[i]
        for r in range(3):
            scale[i, r] = placing.home_scale[home, i, r]
            pos[i, r] = body_pos[b, r]
            for c in range(3):
                pos[i, r] += body_mat[b, r, c] * placing.pos[i, c]
                rot[i, r, c] = (
                    body_mat[b, r, 0] * placing.mat[i, 0, c]
                    + body_mat[b, r, 1] * placing.mat[i, 1, c]
                    + body_mat[b, r, 2] * placing.mat[i, 2, c]
                )
        own = geometry.mesh_ball
        mesh = placing.mesh[i]
        x = own[mesh, 0] * scale[i, 0]
        y = own[mesh, 1] * scale[i, 1]
        z = own[mesh, 2] * scale[i, 2]
        for r in range(3):
            ball[r, k - start] = pos[i, r] + rot[i, r, 0] * x + rot[i, r, 1] * y + rot[i, r, 2] * z
        grow = max(abs(scale[i, 0]), abs(scale[i, 1]), abs(scale[i, 2]))
        ball[3, k - start] = own[mesh, 3] * grow if pos[i, 2] >= PARKED_BELOW else -np.inf


@inline
def _balls_inside(scratch, first, last, lens, width, height):
    """Fill ``inside[first:last]``: False if the ball around an instance is out of the picture for sure."""
    f = lens.focal
    cx = 0.5 * width
    cy = 0.5 * height
    # A plane through the side of the picture has the normal (f, cx) / side_x in (x, z).
    side_x = np.sqrt(f * f + cx * cx)
    side_y = np.sqrt(f * f + cy * cy)
    fx = np.float32(f / side_x)
    zx = np.float32(cx / side_x)
    fy = np.float32(f / side_y)
    zy = np.float32(cy / side_y)
    m = lens.mat
    m00 = np.float32(m[0, 0])
    m10 = np.float32(m[1, 0])
    m20 = np.float32(m[2, 0])
    m01 = np.float32(m[0, 1])
    m11 = np.float32(m[1, 1])
    m21 = np.float32(m[2, 1])
    m02 = np.float32(m[0, 2])
    m12 = np.float32(m[1, 2])
    m22 = np.float32(m[2, 2])
    px = np.float32(lens.pos[0])
    py = np.float32(lens.pos[1])
    pz = np.float32(lens.pos[2])
    slack = np.float32(BALL_SLACK)
    ball = scratch.ball
    inside = scratch.inside
    for k in range(np.uint64(first), np.uint64(last)):
        dx = ball[0, k] - px
        dy = ball[1, k] - py
        dz = ball[2, k] - pz
        r = ball[3, k] + slack
        x = abs(m00 * dx + m10 * dy + m20 * dz)
        y = abs(m01 * dx + m11 * dy + m21 * dz)
        z = -(m02 * dx + m12 * dy + m22 * dz)
        inside[k] = (z >= -r) & (x * fx - z * zx <= r) & (y * fy - z * zy <= r)


@inline
def _to_view(scratch, i, k, lens):
    """Write ``to_view[k]``, the map (3, 4) from the mesh of instance ``i`` to the view frame, scale included."""
    view = scratch.to_view
    rot = scratch.rot
    scale = scratch.scale
    d0 = scratch.pos[i, 0] - lens.pos[0]
    d1 = scratch.pos[i, 1] - lens.pos[1]
    d2 = scratch.pos[i, 2] - lens.pos[2]
    for r in range(3):
        sign = 1.0 if r == 0 else -1.0
        m0 = sign * lens.mat[0, r]
        m1 = sign * lens.mat[1, r]
        m2 = sign * lens.mat[2, r]
        for c in range(3):
            view[k, r, c] = (m0 * rot[i, 0, c] + m1 * rot[i, 1, c] + m2 * rot[i, 2, c]) * scale[
                i, c
            ]
        view[k, r, 3] = m0 * d0 + m1 * d1 + m2 * d2


@inline
def _box_in_sight(geometry, mesh, k, lens, width, height, scratch):
    """Whether the box of a mesh with ``to_view[k]`` can cover the centre of a pixel.

    Fills ``nearest[k]``, its smallest depth [m], 0 if it crosses the near plane; ``rect[k]``: first and last + 1 of
    columns and rows, the whole image if it crosses; else ``corners[k]``: column, row, inverse depth of its corners.
    """
    view = scratch.to_view
    out = scratch.corners
    rect = scratch.rect
    middle = geometry.mesh_middle
    half = geometry.mesh_half
    cx = 0.5 * width
    cy = 0.5 * height
    focal = lens.focal
    for r in range(3):
        at = (
            view[k, r, 0] * middle[mesh, 0]
            + view[k, r, 1] * middle[mesh, 1]
            + view[k, r, 2] * middle[mesh, 2]
            + view[k, r, 3]
        )
        a = view[k, r, 0] * half[mesh, 0]
        b = view[k, r, 1] * half[mesh, 1]
        c = view[k, r, 2] * half[mesh, 2]
        for corner in range(8):
            out[k, r, corner] = (
                at + SIGNS[0, corner] * a + SIGNS[1, corner] * b + SIGNS[2, corner] * c
            )
    nearest = out[k, 2, 0]
    for corner in range(1, 8):
        nearest = min(nearest, out[k, 2, corner])
    if nearest < lens.near:
        left = 0
        right = 0
        top = 0
        bottom = 0
        behind = 0
        for corner in range(8):
            x = focal * out[k, 0, corner]
            y = focal * out[k, 1, corner]
            z = out[k, 2, corner]
            left += x < -cx * z
            right += x > cx * z
            top += y < -cy * z
            bottom += y > cy * z
            behind += z < lens.near
        scratch.nearest[k] = 0.0
        rect[k, 0] = 0
        rect[k, 1] = width
        rect[k, 2] = 0
        rect[k, 3] = height
        return max(left, right, top, bottom, behind) < 8
    x0 = np.inf
    x1 = -np.inf
    y0 = np.inf
    y1 = -np.inf
    for corner in range(8):
        w = 1.0 / out[k, 2, corner]
        x = cx + focal * out[k, 0, corner] * w
        y = cy + focal * out[k, 1, corner] * w
        out[k, 0, corner] = x
        out[k, 1, corner] = y
        out[k, 2, corner] = w
        x0 = min(x0, x)
        x1 = max(x1, x)
        y0 = min(y0, y)
        y1 = max(y1, y)
    scratch.nearest[k] = nearest
    rect[k, 0] = int(min(max(x0, 0.0), width) + (0.5 - RECT_SLACK))
    rect[k, 1] = int(min(max(x1, 0.0), width) + (0.5 + RECT_SLACK))
    rect[k, 2] = int(min(max(y0, 0.0), height) + (0.5 - RECT_SLACK))
    rect[k, 3] = int(min(max(y1, 0.0), height) + (0.5 + RECT_SLACK))
    return rect[k, 0] < rect[k, 1] and rect[k, 2] < rect[k, 3]


@kernel
def find_in_sight(geometry, placing, home, which, lens, width, height, scratch):
    """Fill the scratch with the instances of a home that a camera may see; returns how many.

    ``which`` 0: all; 1: those that stand in the world; 2: those on bodies.
    """
    start = placing.start[home]
    first = placing.moving[home] - start if which == 2 else 0
    last = (placing.moving[home] if which == 1 else placing.start[home + 1]) - start
    still = placing.moving[home] - start
    _balls_inside(scratch, first, last, lens, width, height)
    found = 0
    chosen = scratch.in_sight
    for k in range(first, last):
        chosen[found] = k
        found += scratch.inside[k]
    count = 0
    for n in range(found):
        k = chosen[n]
        i = placing.present[start + k]
        if k < still:
            for r in range(3):
                scratch.pos[i, r] = placing.home_pos[home, i, r]
                scratch.scale[i, r] = placing.home_scale[home, i, r]
                for c in range(3):
                    scratch.rot[i, r, c] = placing.home_mat[home, i, r, c]
        _to_view(scratch, i, count, lens)
        chosen[count] = i
        count += _box_in_sight(geometry, placing.mesh[i], count, lens, width, height, scratch)
    return count


@kernel
def sort_by_depth(count, scratch):
    """Fill ``order`` with the places 0..count from near to far, in order of place within a bucket."""
    starts = scratch.buckets
    starts[:] = 0
    for k in range(count):
        starts[_bucket(scratch.nearest[k]) + 1] += 1
    for b in range(ORDER_BUCKETS):
        starts[b + 1] += starts[b]
    for k in range(count):
        b = _bucket(scratch.nearest[k])
        scratch.order[starts[b]] = k
        starts[b] += 1


@inline
def _bucket(nearest):
    return int(min(nearest * BUCKETS_PER_M, ORDER_BUCKETS - 1.0))


@inline
def hidden(inverse, rect, k, nearest):
    """True if everything drawn inside the rectangle ``rect[k]`` is nearer than ``nearest`` [m]."""
    limit = np.float32(1.0 / nearest)
    left = np.uint64(rect[k, 0])
    right = np.uint64(rect[k, 1])
    for y in range(np.uint64(rect[k, 2]), np.uint64(rect[k, 3])):
        seen = 0
        for x in range(left, right):
            seen += inverse[y, x] < limit
        if seen > 0:
            return False
    return True
