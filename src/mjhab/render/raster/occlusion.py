"""Kernels of screen-space ambient occlusion on cells of pixels."""

from __future__ import annotations

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
def _blocked(inverse, y, x, focal, turn):
    """Occlusion 0..1 of one pixel, without the factor `STRENGTH`; ``turn`` is its sample pattern.

    The loop over samples has no branches and no stores and is float32, so that the compiler computes several at a time.
    """
    height, width = inverse.shape
    cx = _HALF * np.float32(width)
    cy = _HALF * np.float32(height)
    focal_inv = _ONE / focal
    w = inverse[y, x]
    gx = _slope(inverse, y, x, 0, 1)
    gy = _slope(inverse, y, x, 1, 0)
    from_x = np.float32(x) + _HALF
    from_y = np.float32(y) + _HALF
    u = from_x - cx
    v = from_y - cy
    nx = -gx * focal
    ny = -gy * focal
    nz = -(w - gx * u - gy * v)
    inv = _ONE / np.sqrt(nx * nx + ny * ny + nz * nz + _LEAST)
    nx = nx * inv
    ny = ny * inv
    nz = nz * inv
    z = _ONE / w
    px = u * focal_inv * z
    py = v * focal_inv * z
    reach = min(_RADIUS * focal * w, _OF_HEIGHT * np.float32(height))
    last_col = np.int32(width - 1)
    last_row = np.int32(height - 1)
    total = _ZERO
    for k in range(np.uint64(TAPS)):
        col = np.int32(from_x + reach * _DISK_X[turn, k])
        row = np.int32(from_y + reach * _DISK_Y[turn, k])
        inner_col = min(max(col, np.int32(0)), last_col)
        inner_row = min(max(row, np.int32(0)), last_row)
        found = inverse[np.uint64(inner_row), np.uint64(inner_col)]
        counts = (col == inner_col) & (row == inner_row) & (found > _ZERO)
        qz = _ONE / (found if counts else _ONE)
        dx = (np.float32(col) + _HALF - cx) * focal_inv * qz - px
        dy = (np.float32(row) + _HALF - cy) * focal_inv * qz - py
        dz = qz - z
        square = dx * dx + dy * dy + dz * dz
        rise = max(dx * nx + dy * ny + dz * nz - _BIAS * z, _ZERO)
        fade = max(_ONE - square / (_RADIUS * _RADIUS), _ZERO)
        blocked = rise / np.sqrt(square + _SOFTEN) * fade
        total += blocked if counts else _ZERO
    return total / np.float32(TAPS)


@color_kernel
def ambient_occlusion(inverse, step, focal, raw, share, depths):
    """Fill ``share`` (a, b) f32 with the openness 0.15..1 (1: not occluded) of cells of ``step`` x ``step`` pixels.

    ``inverse`` (h, w) f32 is the inverse depth [1/m] and ``focal`` its camera's focal length [px]. ``depths`` (a, b)
    f32 gets the inverse depth of each cell's middle pixel; ``raw`` (a, b) f32 is scratch.
    """
    height, width = share.shape
    focal = np.float32(focal)
    for i in range(height):
        for j in range(width):
            y = min(i * step + step // 2, inverse.shape[0] - 1)
            x = min(j * step + step // 2, inverse.shape[1] - 1)
            depths[i, j] = inverse[y, x]
            raw[i, j] = 0.0
            if inverse[y, x] > 0.0:
                raw[i, j] = _blocked(inverse, y, x, focal, (i & 3) * 4 + (j & 3))
    for i in range(height):
        for j in range(width):
            total = _ZERO
            weight = np.float32(1e-9)
            for y in range(max(i - 2, 0), min(i + 2, height)):
                for x in range(max(j - 2, 0), min(j + 2, width)):
                    if abs(depths[y, x] - depths[i, j]) < _ALIKE * depths[i, j]:
                        total += raw[y, x]
                        weight += _ONE
            share[i, j] = max(_ONE - _STRENGTH * total / weight, _MOST_SHADE)
