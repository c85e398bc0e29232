"""Kernels of screen-space ambient occlusion on cells of pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.render.jit import color_inline, color_kernel

RADIUS = 0.3
"""Largest distance [m] at which surfaces occlude each other."""
STRENGTH = 2.4
"""Factor on the mean occlusion of the samples."""
TAPS = 12
"""Number of samples per cell."""
TURNS = 16
"""Number of rotated sample patterns: one per cell of a 4 x 4 block, which the blur averages."""


def _disk() -> np.ndarray:
    """Sample offsets (TURNS, TAPS, 2) on the unit disk: a golden-angle spiral, rotated per cell by a Bayer matrix."""
    k = np.arange(TAPS)
    bayer = np.array([0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5])
    angle = k[None] * 2.39996 + bayer[:, None] * (2.0 * np.pi / TURNS)
    reach = (
        np.sqrt((k + 0.5) / TAPS)[None]
        * (0.7 + 0.3 * ((bayer * 7 % TURNS) / TURNS))[:, None]
    )
    return np.stack([reach * np.cos(angle), reach * np.sin(angle)], -1)


DISK = _disk()
_DISK_X, _DISK_Y = (np.ascontiguousarray(DISK[..., k], np.float32) for k in range(2))
"""(TURNS, TAPS) f32 each: the offsets along columns and rows."""
BORDER = 2
"""Cells without a surface around those of an image, so that the blur needs no test for edges."""
MOST_POINTS = 1024
"""Most points, middles of cells, whose occlusion is computed together."""
VECTOR = 8
"""Numbers that the processor computes with one instruction."""
POINT_ROW = MOST_POINTS + 16
"""Length of a row of ``points``, see `lighting.NODE_ROW`. The rows are column and row COL, ROW [px]; the unit normal
NX, NY and the depth Z [m] of the point in the view frame; the rest of the normal NZ and of the position X, Y [m];
REACH, the largest distance of its samples [px]; SEEN, the inverse depth at the current sample [1/m], 0 for none;
BLOCKED, the sum of what they hide."""
POINT_ROWS = 11
COL, ROW, NX, NY, Z, NZ, X, Y, REACH, SEEN, BLOCKED = (
    np.uint64(row * POINT_ROW) for row in range(POINT_ROWS)
)
_BORDER = np.uint64(BORDER)
_TAPS = np.float32(TAPS)
_TINY = np.float32(1e-9)
_ZERO = np.float32(0.0)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)
_RADIUS = np.float32(RADIUS)
_BIAS = np.float32(0.004)
"""Rise above the plane of the surface, relative to the depth, that does not count: rounding errors of the depths."""
_SOFTEN = np.float32(1e-4)
_LEAST = np.float32(1e-20)
_STRENGTH = np.float32(STRENGTH)
_MOST_SHADE = np.float32(0.15)
_OF_HEIGHT = np.float32(0.2)
"""Largest distance of a sample on screen, as a share of the image's height."""
_ALIKE = np.float32(0.05)
"""Relative difference of depth up to which the blur takes cells for one surface."""


class OcclusionCells(NamedTuple):
    """Ambient occlusion of a x b cells, and working memory of one thread.

    Attributes:
        share: (a, b) f32, openness 0.15..1 (1: not occluded).
        depths: (a + 4, b + 4) f32, inverse depth of each cell's middle pixel [1/m], 0 in the `BORDER`.
        raw: (a + 4, b + 4) f32, occlusion before the blur.
        points: f32, see `POINT_ROW`; where: (MOST_POINTS, 2) i64, their places in ``raw``; found: (MOST_POINTS,) i32,
            the pixels of their samples.
    """

    share: np.ndarray
    depths: np.ndarray
    raw: np.ndarray
    points: np.ndarray
    where: np.ndarray
    found: np.ndarray


def make_cells(rows: int, columns: int) -> OcclusionCells:
    """Allocate the memory for an image of this many cells."""
    padded = (rows + 2 * BORDER, columns + 2 * BORDER)
    return OcclusionCells(
        np.empty((rows, columns), np.float32),
        np.zeros(padded, np.float32),
        np.zeros(padded, np.float32),
        np.empty(POINT_ROWS * POINT_ROW, np.float32),
        np.empty((MOST_POINTS, 2), np.int64),
        np.empty(MOST_POINTS, np.int32),
    )


@color_inline
def _slope(inverse, y, x, dy, dx):
    """Change of inverse depth per pixel along (dy, dx): the smaller one-sided difference, to ignore depth edges."""
    height, width = inverse.shape
    w = inverse[y, x]
    ya = min(y + dy, height - 1)
    xa = min(x + dx, width - 1)
    yb = max(y - dy, 0)
    xb = max(x - dx, 0)
    forward = inverse[ya, xa] - w
    backward = w - inverse[yb, xb]
    if ya == y and xa == x:
        return backward
    if yb == y and xb == x:
        return forward
    return forward if abs(forward) < abs(backward) else backward


@color_inline
def _face_points(inverse, focal, points, count):
    """Compute the normals and positions of the first ``count`` points of one sample pattern, and how far they look.

    Before, row Z holds the inverse depth of each point, and NX and NY its changes per column and row.
    """
    height, width = inverse.shape
    cx = _HALF * np.float32(width)
    cy = _HALF * np.float32(height)
    focal_inv = _ONE / focal
    for n in range(np.uint64(count)):
        w = points[n + Z]
        gx = points[n + NX]
        gy = points[n + NY]
        u = points[n + COL] - cx
        v = points[n + ROW] - cy
        nx = -gx * focal
        ny = -gy * focal
        nz = -(w - gx * u - gy * v)
        inv = _ONE / np.sqrt(nx * nx + ny * ny + nz * nz + _LEAST)
        z = _ONE / w
        points[n + NX] = nx * inv
        points[n + NY] = ny * inv
        points[n + NZ] = nz * inv
        points[n + X] = u * focal_inv * z
        points[n + Y] = v * focal_inv * z
        points[n + Z] = z
        points[n + REACH] = min(_RADIUS * focal * w, _OF_HEIGHT * np.float32(height))
        points[n + BLOCKED] = _ZERO


@color_inline
def _add_samples(shape, flat, focal, off_x, off_y, cells, count):
    """Add to row BLOCKED what the sample at (off_x, off_y) of the pattern hides from each of the points.

    The outer loops are float32 and have neither branches nor reads at computed places: only so the compiler computes
    eight points at a time.
    """
    height, width = shape
    points = cells.points
    found = cells.found
    cx = _HALF * np.float32(width)
    cy = _HALF * np.float32(height)
    focal_inv = _ONE / focal
    columns = np.int32(width)
    rows = np.int32(height)
    outside = rows * columns
    every = range(np.uint64(count))
    for n in every:
        reach = points[n + REACH]
        col = np.int32(points[n + COL] + reach * off_x)
        row = np.int32(points[n + ROW] + reach * off_y)
        inside = (col >= 0) & (col < columns) & (row >= 0) & (row < rows)
        found[n] = row * columns + col if inside else outside
    for n in every:
        points[n + SEEN] = flat[np.uint64(found[n])]
    for n in every:
        reach = points[n + REACH]
        col = np.float32(np.int32(points[n + COL] + reach * off_x))
        row = np.float32(np.int32(points[n + ROW] + reach * off_y))
        seen = points[n + SEEN]
        qz = _ONE / max(seen, _TINY)
        z = points[n + Z]
        dx = (col + _HALF - cx) * focal_inv * qz - points[n + X]
        dy = (row + _HALF - cy) * focal_inv * qz - points[n + Y]
        dz = qz - z
        square = dx * dx + dy * dy + dz * dz
        above = dx * points[n + NX] + dy * points[n + NY] + dz * points[n + NZ]
        rise = max(above - _BIAS * z, _ZERO)
        fade = max(_ONE - square / (_RADIUS * _RADIUS), _ZERO)
        blocked = rise / np.sqrt(square + _SOFTEN) * fade
        points[n + BLOCKED] += blocked if seen > _ZERO else _ZERO


@color_inline
def _sample(inverse, flat, focal, turn, cells, count):
    """Write the occlusion 0..1, without the factor `STRENGTH`, of the first ``count`` points into ``cells.raw``.

    All have the sample pattern ``turn``.
    """
    points = cells.points
    # Copies of the last point fill the processor's vectors: a loop over what is left over would be slower.
    padded = (count + VECTOR - 1) // VECTOR * VECTOR
    for n in range(count, padded):
        for r in range(5):
            points[POINT_ROW * r + n] = points[POINT_ROW * r + count - 1]
    _face_points(inverse, focal, points, padded)
    for k in range(TAPS):
        off_x = _DISK_X[turn, k]
        off_y = _DISK_Y[turn, k]
        _add_samples(inverse.shape, flat, focal, off_x, off_y, cells, padded)
    for n in range(count):
        cells.raw[cells.where[n, 0], cells.where[n, 1]] = points[n + BLOCKED] / _TAPS


@color_inline
def _blur(cells):
    """Fill ``cells.share`` from the occlusion of 4 x 4 cells around each, as far as they are at its depth."""
    height, width = cells.share.shape
    raw = cells.raw
    depths = cells.depths
    for i in range(np.uint64(height)):
        for j in range(np.uint64(width)):
            middle = depths[i + _BORDER, j + _BORDER]
            total = _ZERO
            weight = _TINY
            for y in range(np.uint64(4)):
                for x in range(np.uint64(4)):
                    alike = abs(depths[i + y, j + x] - middle) < _ALIKE * middle
                    total += raw[i + y, j + x] if alike else _ZERO
                    weight += _ONE if alike else _ZERO
            cells.share[i, j] = max(_ONE - _STRENGTH * total / weight, _MOST_SHADE)


@color_kernel
def ambient_occlusion(inverse, flat, step, focal, cells):
    """Fill ``share`` and ``depths`` of ``cells``, see `OcclusionCells`, for cells of ``step`` x ``step`` pixels.

    ``inverse`` (h, w) f32 is the inverse depth [1/m], ``flat`` the same by rows and a 0 behind the last, and ``focal``
    its camera's focal length [px].
    """
    height, width = cells.share.shape
    points = cells.points
    focal = np.float32(focal)
    for turn in range(TURNS):
        count = 0
        for i in range(turn >> 2, height, 4):
            y = min(i * step + step // 2, inverse.shape[0] - 1)
            for j in range(turn & 3, width, 4):
                x = min(j * step + step // 2, inverse.shape[1] - 1)
                w = inverse[y, x]
                cells.depths[i + BORDER, j + BORDER] = w
                cells.raw[i + BORDER, j + BORDER] = _ZERO
                if w <= _ZERO:
                    continue
                points[count + COL] = np.float32(x) + _HALF
                points[count + ROW] = np.float32(y) + _HALF
                points[count + NX] = _slope(inverse, y, x, 0, 1)
                points[count + NY] = _slope(inverse, y, x, 1, 0)
                points[count + Z] = w
                cells.where[count, 0] = i + BORDER
                cells.where[count, 1] = j + BORDER
                count += 1
                if count == MOST_POINTS:
                    _sample(inverse, flat, focal, turn, cells, count)
                    count = 0
        if count > 0:
            _sample(inverse, flat, focal, turn, cells, count)
    _blur(cells)
