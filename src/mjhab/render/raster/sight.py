"""Kernels that cull instances: bounding spheres against the frustum, projected bounding boxes, then occlusion.

The tests are conservative: no instance that is nearest at the centre of a pixel is culled, so images are the same as
without culling.
"""

from __future__ import annotations

import numpy as np

from mjhab.render.jit import inline, kernel
from mjhab.render.raster.arrays import ORDER_BUCKETS, PARKED_BELOW

BALL_SLACK = 1e-3
"""Added to the radii of bounding spheres [m], to cover the rounding errors of the float32 test."""
RECT_SLACK = 1e-6
"""Pixels whose centres are at most this far outside a rectangle [px] count as inside."""
BUCKETS_PER_M = 12.0
"""Buckets of the front-to-back order per metre of depth [1/m]."""
SIGNS = np.array(
    [[-1.0 if k >> axis & 1 == 0 else 1.0 for k in range(8)] for axis in range(3)]
)
"""(3, 8): corner k of a box lies on the positive side of axis a if bit a of k is set."""


@kernel
def place_balls(placing, home, bodies, scratch):
    """Write the bounding spheres of all instances present in a home, in the world frame, into ``scratch.ball``.

    The radius of a parked instance is -inf, so that it fails every test.
    """
    ball = scratch.ball
    start = placing.start[home]
    for r in range(4):
        for k in range(start, placing.moving[home]):
            ball[r, k - start] = placing.ball[r, k]
    for k in range(placing.moving[home], placing.start[home + 1]):
        b = placing.body[placing.present[k]]
        x = placing.ball[0, k]
        y = placing.ball[1, k]
        z = placing.ball[2, k]
        mat = bodies.mat
        n = k - start
        for r in range(3):
            ball[r, n] = (
                bodies.pos[b, r] + mat[b, r, 0] * x + mat[b, r, 1] * y + mat[b, r, 2] * z
            )
        ball[3, n] = placing.ball[3, k] if ball[2, n] >= PARKED_BELOW else -np.inf


@inline
def _place(placing, home, i, bodies, scratch):
    """Write the world pose and the scale of instance ``i`` into the scratch: from the home, or from its body's pose."""
    pos = scratch.pos
    rot = scratch.rot
    b = placing.body[i]
    for r in range(3):
        scratch.scale[i, r] = placing.home_scale[home, i, r]
    if b == 0:
        for r in range(3):
            pos[i, r] = placing.home_pos[home, i, r]
            for c in range(3):
                rot[i, r, c] = placing.home_mat[home, i, r, c]
        return
    mat = bodies.mat
    for r in range(3):
        m0 = mat[b, r, 0]
        m1 = mat[b, r, 1]
        m2 = mat[b, r, 2]
        pos[i, r] = (
            bodies.pos[b, r]
            + m0 * placing.pos[i, 0]
            + m1 * placing.pos[i, 1]
            + m2 * placing.pos[i, 2]
        )
        for c in range(3):
            rot[i, r, c] = (
                m0 * placing.mat[i, 0, c]
                + m1 * placing.mat[i, 1, c]
                + m2 * placing.mat[i, 2, c]
            )


@inline
def _balls_inside(scratch, first, last, lens, width, height):
    """Fill ``inside[first:last]``: False if the bounding sphere of an instance lies outside the view frustum."""
    f = lens.focal
    cx = 0.5 * width
    cy = 0.5 * height
    # A side plane of the frustum has the unit normal (f, -cx) / side_x in (|x|, z).
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
    """Write ``to_view[k]``, the affine map (3, 4) from the mesh of instance ``i`` to the view frame, scale included."""
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
            view[k, r, c] = (
                m0 * rot[i, 0, c] + m1 * rot[i, 1, c] + m2 * rot[i, 2, c]
            ) * scale[i, c]
        view[k, r, 3] = m0 * d0 + m1 * d1 + m2 * d2


@inline
def _corners_in_view(geometry, mesh, k, scratch):
    """Fill ``corners[k]`` (3, 8) with the corners of a mesh's bounding box in the view frame [m].

    Returns their smallest depth [m].
    """
    view = scratch.to_view
    out = scratch.corners
    middle = geometry.mesh_middle
    half = geometry.mesh_half
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
    return nearest


@inline
def _crosses_the_view(k, lens, width, height, scratch):
    """False if all corners ``corners[k]`` [m] lie outside the same side plane of the frustum or its near plane."""
    out = scratch.corners
    cx = 0.5 * width
    cy = 0.5 * height
    focal = lens.focal
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
    return max(left, right, top, bottom, behind) < 8


@inline
def _project_corners(k, lens, width, height, scratch):
    """Project ``corners[k]`` in place from the view frame [m] to column, row [px] and inverse depth [1/m].

    Fills ``rect[k]`` with the bounding rectangle in the image; returns whether it contains the centre of a pixel.
    """
    out = scratch.corners
    rect = scratch.rect
    cx = 0.5 * width
    cy = 0.5 * height
    focal = lens.focal
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
    rect[k, 0] = int(min(max(x0, 0.0), width) + (0.5 - RECT_SLACK))
    rect[k, 1] = int(min(max(x1, 0.0), width) + (0.5 + RECT_SLACK))
    rect[k, 2] = int(min(max(y0, 0.0), height) + (0.5 - RECT_SLACK))
    rect[k, 3] = int(min(max(y1, 0.0), height) + (0.5 + RECT_SLACK))
    return rect[k, 0] < rect[k, 1] and rect[k, 2] < rect[k, 3]


@inline
def _box_in_sight(geometry, mesh, k, lens, width, height, scratch):
    """Whether the bounding box of a mesh with ``to_view[k]`` can cover the centre of a pixel.

    Fills ``nearest[k]``, its smallest depth [m]; ``rect[k]``, its half-open ranges of columns and rows; ``corners[k]``,
    column, row and inverse depth of its corners. If the box crosses the near plane, ``nearest`` is 0, ``rect`` the
    whole image, and ``corners`` not projected.
    """
    nearest = _corners_in_view(geometry, mesh, k, scratch)
    if nearest < lens.near:
        rect = scratch.rect
        scratch.nearest[k] = 0.0
        rect[k, 0] = 0
        rect[k, 1] = width
        rect[k, 2] = 0
        rect[k, 3] = height
        return _crosses_the_view(k, lens, width, height, scratch)
    scratch.nearest[k] = nearest
    return _project_corners(k, lens, width, height, scratch)


@kernel
def find_in_sight(geometry, placing, home, which, bodies, lens, width, height, scratch):
    """List the instances of a home that a camera may see, after `place_balls`; returns their number.

    Fills pose, ``in_sight``, ``to_view``, ``nearest``, ``rect`` and ``corners`` of the scratch. ``which`` selects the
    instances: 0 all, 1 those in the world, 2 those on bodies.
    """
    start = placing.start[home]
    first = placing.moving[home] - start if which == 2 else 0
    last = (placing.moving[home] if which == 1 else placing.start[home + 1]) - start
    _balls_inside(scratch, first, last, lens, width, height)
    found = 0
    chosen = scratch.in_sight
    for k in range(first, last):
        chosen[found] = k
        found += scratch.inside[k]
    count = 0
    for n in range(found):
        i = placing.present[start + chosen[n]]
        _place(placing, home, i, bodies, scratch)
        _to_view(scratch, i, count, lens)
        chosen[count] = i
        count += _box_in_sight(
            geometry, placing.mesh[i], count, lens, width, height, scratch
        )
    return count


@kernel
def sort_by_depth(count, scratch):
    """Fill ``order`` with the indices 0..count - 1 by bucket of ``nearest``, front to back; a stable counting sort."""
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
    """Whether the z-buffer is at least as near as ``nearest`` [m] in every pixel of the rectangle ``rect[k]``."""
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
