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
    """Occlusion 0..1 of one pixel, without the factor `STRENGTH`; ``turn`` is its sample pattern."""
    height, width = inverse.shape
    cx = 0.5 * width
    cy = 0.5 * height
    w = inverse[y, x]
    gx = _slope(inverse, y, x, 0, 1)
    gy = _slope(inverse, y, x, 1, 0)
    u = x + 0.5 - cx
    v = y + 0.5 - cy
    nx = -gx * focal
    ny = -gy * focal
    nz = -(w - gx * u - gy * v)
    inv = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz + 1e-20)
    nx = nx * inv
    ny = ny * inv
    nz = nz * inv
    z = 1.0 / w
    px = u / focal * z
    py = v / focal * z
    reach = min(RADIUS * focal * w, 0.2 * height)
    total = 0.0
    for k in range(TAPS):
        col = int(x + 0.5 + reach * DISK[turn, k, 0])
        row = int(y + 0.5 + reach * DISK[turn, k, 1])
        if (
            col < 0
            or row < 0
            or col >= width
            or row >= height
            or inverse[row, col] <= 0.0
        ):
            continue
        qz = 1.0 / inverse[row, col]
        dx = (col + 0.5 - cx) / focal * qz - px
        dy = (row + 0.5 - cy) / focal * qz - py
        dz = qz - z
        square = dx * dx + dy * dy + dz * dz
        if square < RADIUS * RADIUS:
            rise = max(dx * nx + dy * ny + dz * nz - 0.004 * z, 0.0)
            total += rise / np.sqrt(square + 1e-4) * (1.0 - square / (RADIUS * RADIUS))
    return total / TAPS


@color_kernel
def ambient_occlusion(inverse, step, focal, raw, share, depths):
    """Fill ``share`` (a, b) f32 with the openness 0.15..1 (1: not occluded) of cells of ``step`` x ``step`` pixels.

    ``inverse`` (h, w) f32 is the inverse depth [1/m] and ``focal`` its camera's focal length [px]. ``depths`` (a, b)
    f32 gets the inverse depth of each cell's middle pixel; ``raw`` (a, b) f32 is scratch.
    """
    height, width = share.shape
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
            total = 0.0
            weight = 1e-9
            for y in range(max(i - 2, 0), min(i + 2, height)):
                for x in range(max(j - 2, 0), min(j + 2, width)):
                    if abs(depths[y, x] - depths[i, j]) < 0.05 * depths[i, j]:
                        total += raw[y, x]
                        weight += 1.0
            share[i, j] = max(1.0 - STRENGTH * total / weight, 0.15)
