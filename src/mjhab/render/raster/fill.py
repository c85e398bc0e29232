"""Kernels that rasterise projected triangles and quadrangles into a z-buffer.

``inverse`` (h, w) f32 holds inverse depth [1/m], which is linear on screen: 0 is background, larger is nearer. ``ids``
(h, w) i32 gets ``tag`` wherever a fragment is nearest. Corners are columns x, rows y [px] and inverse depths w; ``gx``
and ``gy`` are the change of inverse depth per column and row; left, right, top, bottom are the first and last columns
and rows to fill.
"""

from __future__ import annotations

import numpy as np

from mjhab.render.jit import inline, kernel
from mjhab.render.lanes import LANES, draw_lanes

EDGE_SLACK = 1e-7
"""Pixel centres at most this far outside an edge count as inside, so that shared edges leave no holes."""
SMALL = 2
"""Triangles whose bounding rectangle has up to this many pixels are filled by testing every pixel."""


@inline
def _fill_small(
    inverse, ids, tag, x0, y0, x1, y1, x2, y2, w0, gx, gy, left, right, top, bottom
):
    """Fill a triangle (corners in the order of positive area) by testing every pixel of its bounding rectangle."""
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


@inline
def _bound(xa, ya, xb, yb, y):
    """Intersection of the edge a-b with the horizontal line ``y``.

    Returns its x, the change of x per row, and on which side of the edge the polygon lies: 1 left, -1 right, 0 for a
    horizontal edge.
    """
    rise = yb - ya
    if rise == 0.0:
        return 0.0, 0.0, 0
    slope = (xb - xa) / rise
    return xa + slope * (y - ya), slope, (1 if rise > 0.0 else -1)


@inline
def _fill_rows(
    inverse, ids, tag, x0, y0, x1, y1, x2, y2, w0, gx, gy, left, right, top, bottom
):
    """Fill a triangle (corners in the order of positive area) row by row within the bounding rectangle."""
    y = top + 0.5
    a, da, side_a = _bound(x0, y0, x1, y1, y)
    b, db, side_b = _bound(x1, y1, x2, y2, y)
    c, dc, side_c = _bound(x2, y2, x0, y0, y)
    # At most two edges bound a row on each side.
    low_a = -np.inf
    low_b = -np.inf
    high_a = np.inf
    high_b = np.inf
    dlow_a = 0.0
    dlow_b = 0.0
    dhigh_a = 0.0
    dhigh_b = 0.0
    if side_a > 0:
        high_a = a
        dhigh_a = da
    elif side_a < 0:
        low_a = a
        dlow_a = da
    if side_b > 0:
        high_b = b
        dhigh_b = db
    elif side_b < 0:
        low_b = b
        dlow_b = db
    if side_c > 0:
        if side_a > 0:
            high_b = c
            dhigh_b = dc
        else:
            high_a = c
            dhigh_a = dc
    elif side_c < 0:
        if side_a < 0:
            low_b = c
            dlow_b = dc
        else:
            low_a = c
            dlow_a = dc
    start = w0 + gy * (y - y0) + gx * (0.5 - x0)
    for row in range(top, bottom + 1):
        first = int(max(low_a, low_b, left + 0.5) + (0.5 - EDGE_SLACK))
        last = int(min(high_a, high_b, right + 0.5) + (0.5 + EDGE_SLACK)) - 1
        _fill_span(
            inverse,
            ids,
            tag,
            row,
            first,
            last - first + 1,
            np.float32(start + gx * first),
            np.float32(gx),
        )
        low_a = low_a + dlow_a
        low_b = low_b + dlow_b
        high_a = high_a + dhigh_a
        high_b = high_b + dhigh_b
        start += gy


@inline
def _fill_span(inverse, ids, tag, row, first, count, start, step):
    """Fill ``count`` pixels of a row from column ``first``; inverse depth is ``start + step * k`` at the k-th."""
    for done in range(0, count, LANES):
        draw_lanes(
            inverse,
            ids,
            np.uint64(row),
            np.uint64(first + done),
            tag,
            start,
            step,
            np.int32(done),
            np.int32(count),
        )


@inline
def fill(inverse, ids, tag, x0, y0, w0, x1, y1, w1, x2, y2, w2, keep):
    """Fill one projected triangle. ``keep`` 0 fills both orientations, 1 or -1 only that sign of area."""
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    if area == 0.0 or area * keep < 0.0:
        return
    height, width = inverse.shape
    # Columns and rows whose centres lie within the bounding rectangle of the triangle.
    left = int(max(min(x0, x1, x2), 0.0) + (0.5 - EDGE_SLACK))
    right = int(min(max(max(x0, x1, x2), -1.0), width) + (0.5 + EDGE_SLACK)) - 1
    top = int(max(min(y0, y1, y2), 0.0) + (0.5 - EDGE_SLACK))
    bottom = int(min(max(max(y0, y1, y2), -1.0), height) + (0.5 + EDGE_SLACK)) - 1
    if left > right or top > bottom:
        return
    gx = ((w1 - w0) * (y2 - y0) - (w2 - w0) * (y1 - y0)) / area
    gy = ((x1 - x0) * (w2 - w0) - (x2 - x0) * (w1 - w0)) / area
    if area < 0.0:
        x1, y1, x2, y2 = x2, y2, x1, y1
    if (right - left + 1) * (bottom - top + 1) <= SMALL:
        _fill_small(
            inverse,
            ids,
            tag,
            x0,
            y0,
            x1,
            y1,
            x2,
            y2,
            w0,
            gx,
            gy,
            left,
            right,
            top,
            bottom,
        )
        return
    _fill_rows(
        inverse, ids, tag, x0, y0, x1, y1, x2, y2, w0, gx, gy, left, right, top, bottom
    )


@inline
def fill_quad(inverse, ids, tag, x0, y0, x1, y1, x2, y2, x3, y3, w0, gx, gy):
    """Fill a convex quadrangle, corners in either orientation; inverse depth is ``w0 + gx * x + gy * y``."""
    height, width = inverse.shape
    left = int(max(min(x0, x1, x2, x3), 0.0) + (0.5 - EDGE_SLACK))
    right = int(min(max(x0, x1, x2, x3, -1.0), width) + (0.5 + EDGE_SLACK)) - 1
    top = int(max(min(y0, y1, y2, y3), 0.0) + (0.5 - EDGE_SLACK))
    bottom = int(min(max(y0, y1, y2, y3, -1.0), height) + (0.5 + EDGE_SLACK)) - 1
    if left > right or top > bottom:
        return
    if (x2 - x0) * (y3 - y1) < (x3 - x1) * (y2 - y0):
        x1, y1, x3, y3 = x3, y3, x1, y1
    y = top + 0.5
    a, da, side_a = _bound(x0, y0, x1, y1, y)
    b, db, side_b = _bound(x1, y1, x2, y2, y)
    c, dc, side_c = _bound(x2, y2, x3, y3, y)
    d, dd, side_d = _bound(x3, y3, x0, y0, y)
    # Up to three edges bound a row on each side; a limit of +-inf disables an edge on the other side.
    low_a = a if side_a < 0 else -np.inf
    low_b = b if side_b < 0 else -np.inf
    low_c = c if side_c < 0 else -np.inf
    low_d = d if side_d < 0 else -np.inf
    high_a = a if side_a > 0 else np.inf
    high_b = b if side_b > 0 else np.inf
    high_c = c if side_c > 0 else np.inf
    high_d = d if side_d > 0 else np.inf
    start = w0 + gy * y + gx * 0.5
    for row in range(top, bottom + 1):
        low = max(max(low_a, low_b), max(low_c, low_d))
        high = min(min(high_a, high_b), min(high_c, high_d))
        first = int(max(low, left + 0.5) + (0.5 - EDGE_SLACK))
        last = int(min(high, right + 0.5) + (0.5 + EDGE_SLACK)) - 1
        _fill_span(
            inverse,
            ids,
            tag,
            row,
            first,
            last - first + 1,
            np.float32(start + gx * first),
            np.float32(gx),
        )
        low_a += da
        low_b += db
        low_c += dc
        low_d += dd
        high_a += da
        high_b += db
        high_c += dc
        high_d += dd
        start += gy


@kernel
def fill_clipped(inverse, ids, tag, points, out, a, b, c, focal, near, keep):
    """Clip a triangle at the near plane and fill the remaining polygon (three or four corners).

    ``points`` (6, V): rows 0 to 2 are view coordinates [m]; a, b, c: the corners' columns in it; ``out`` (4, 3) is
    scratch; ``focal`` [px]; ``near`` [m]; ``keep``: see `fill`.
    """
    height, width = inverse.shape
    count = 0
    for k in range(3):
        p = a if k == 0 else (b if k == 1 else c)
        q = b if k == 0 else (c if k == 1 else a)
        zp = points[2, p]
        zq = points[2, q]
        if zp >= near:
            for r in range(3):
                out[count, r] = points[r, p]
            count += 1
        if (zp >= near) != (zq >= near):
            t = (near - zp) / (zq - zp)
            for r in range(3):
                out[count, r] = points[r, p] + t * (points[r, q] - points[r, p])
            count += 1
    for k in range(count):
        w = 1.0 / out[k, 2]
        out[k, 0] = 0.5 * width + focal * out[k, 0] * w
        out[k, 1] = 0.5 * height + focal * out[k, 1] * w
        out[k, 2] = w
    for k in range(2, count):
        fill(
            inverse, ids, tag, out[0, 0], out[0, 1], out[0, 2], out[k - 1, 0], out[k - 1, 1], out[k - 1, 2],
            out[k, 0], out[k, 1], out[k, 2], keep,
        )  # fmt: skip
