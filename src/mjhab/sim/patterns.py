"""Compiled procedural patterns: the colour of a surface point from its place in the instance's own frame.

``shading.shade`` compiles these in. Numba renews a cached kernel only when the file of the kernel itself changes:
after an edit here, ``touch`` shading.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from mjhab.sim.render_scene import PATTERNS

JIT: dict[str, Any] = {"nogil": True, "cache": True, "error_model": "numpy", "fastmath": True, "_nrt": False}
"""``_nrt`` off: the kernels make no arrays, and counting references to their arguments took 2/3 of the time."""
INLINE: dict[str, Any] = JIT | {"forceinline": True}
"""For helpers called per pixel: a call would copy every array descriptor it is given."""
WOOD = PATTERNS.index("wood")
PLANKS = PATTERNS.index("planks")
TILES = PATTERNS.index("tiles")
FABRIC = PATTERNS.index("fabric")
STRIPES = PATTERNS.index("stripes")


@njit(**INLINE)
def _hash(x, y):
    """Pseudo-random number in 0..1 of two integers."""
    h = (x * 374761393 + y * 668265263) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFF) / 65535.0


@njit(**INLINE)
def _noise(x, y):
    """Smooth value noise in 0..1 with period about 1."""
    fx, fy = np.floor(x), np.floor(y)
    ix, iy = np.int64(fx), np.int64(fy)
    u, v = x - fx, y - fy
    u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
    low = _hash(ix, iy) * (1.0 - u) + _hash(ix + 1, iy) * u
    high = _hash(ix, iy + 1) * (1.0 - u) + _hash(ix + 1, iy + 1) * u
    return low * (1.0 - v) + high * v


@njit(**INLINE)
def _fade(period, pixel):
    """Weight of a detail: 1 when its period is many pixels wide, 0 when it is below two."""
    return min(max(0.5 * period / pixel - 1.0, 0.0), 1.0)


@njit(**INLINE)
def _seam(distance, width, pixel):
    """Coverage of a pixel by a line of ``width`` at ``distance`` from its middle."""
    return min(max((0.5 * width - distance) / pixel + 0.5, 0.0), 1.0) * min(1.0, 1.5 * width / pixel + 0.2)


@njit(**INLINE)
def _wood(u, v, scale, pixel, seed):
    """Grain along u: stretched noise in two octaves, bent by a slow wave."""
    bend = 0.6 * _noise(0.25 * u / scale + seed, 0.5 * v / scale)
    ring = (v / scale + bend) * 2.0
    coarse = _noise(0.22 * u / scale + seed, ring * 1.7)
    fine = _noise(0.9 * u / scale, ring * 9.0 + seed)
    a, b = _fade(0.3 * scale, pixel), _fade(0.06 * scale, pixel)
    return 0.45 + a * (coarse - 0.5) * 0.75 + b * (fine - 0.5) * 0.35


@njit(**INLINE)
def _planks(u, v, scale, pixel):
    """Boards of width ``scale`` and eight times the length, each with its tint; returns (mix, shade)."""
    row = np.floor(v / scale)
    shifted = u / (8.0 * scale) + _hash(np.int64(row), 7)
    board = np.floor(shifted)
    tint = _hash(np.int64(board) * 13 + 5, np.int64(row))
    grain = _wood(u, v, 0.7 * scale, pixel, 17.0 * tint)
    across, along = v / scale - row, shifted - board
    edge = min(across, 1.0 - across) * scale
    end = min(along, 1.0 - along) * 8.0 * scale
    line = max(_seam(edge, 0.006, pixel), _seam(end, 0.006, pixel))
    return 0.55 * tint + 0.45 * grain, 1.0 - 0.45 * line


@njit(**INLINE)
def _tiles(u, v, scale, pixel):
    """Square tiles; returns (mix towards the grout, shade of the tile)."""
    p, q = u / scale, v / scale
    i, j = np.floor(p), np.floor(q)
    a, b = p - i, q - j
    edge = min(min(a, 1.0 - a), min(b, 1.0 - b)) * scale
    shade = 0.95 + 0.08 * _hash(np.int64(i), np.int64(j))
    return _seam(edge, 0.02 * scale + 0.002, pixel), shade


@njit(**INLINE)
def _fabric(u, v, scale, pixel):
    """Woven threads with soft blotches."""
    p, q = np.floor(u / scale * 8.0), np.floor(v / scale * 8.0)
    thread = _hash(np.int64(p), np.int64(q))
    blotch = _noise(1.5 * u / scale, 1.5 * v / scale)
    return 0.4 + 0.5 * _fade(scale / 8.0, pixel) * (thread - 0.5) + 0.6 * _fade(scale, pixel) * (blotch - 0.5)


@njit(**INLINE)
def _stripes(u, scale, pixel):
    """Two equal stripes per period, edges smoothed over a pixel."""
    p = u / scale - np.floor(u / scale)
    d = (0.25 - abs(p - 0.5)) * scale
    mix = min(max(d / pixel + 0.5, 0.0), 1.0)
    return 0.5 + (mix - 0.5) * _fade(scale, pixel)


@njit(**INLINE)
def _plane(x, y, z, nx, ny, nz, sx, sy, sz):
    """Coordinates (u, v) on the face a normal looks out of; u runs along its longer side."""
    ax, ay, az = abs(nx), abs(ny), abs(nz)
    if az >= ax and az >= ay:
        u, v, longer = x, y, sx >= sy
    elif ax >= ay:
        u, v, longer = y, z, sy >= sz
    else:
        u, v, longer = x, z, sx >= sz
    return (u, v) if longer else (v, u)


@njit(**INLINE)
def pattern(kind, scale, x, y, z, nx, ny, nz, sx, sy, sz, pixel):
    """Mix (0: first colour, 1: second) and shade (factor) at a point.

    x, y, z [m] and nx, ny, nz: point and normal in the instance's frame; sx, sy, sz: size of the piece,
    which turns grain and boards along its longer side; pixel: size of a pixel on the surface [m].
    """
    u, v = _plane(x, y, z, nx, ny, nz, sx, sy, sz)
    mix, shade = 0.0, 1.0
    if kind == WOOD:
        mix = _wood(u, v, scale, pixel, 3.0 * (nx + 2.0 * ny))
    elif kind == PLANKS:
        mix, shade = _planks(u, v, scale, pixel)
    elif kind == TILES:
        mix, shade = _tiles(u, v, scale, pixel)
    elif kind == FABRIC:
        mix = _fabric(u, v, scale, pixel)
    elif kind == STRIPES:
        mix = _stripes(u, scale, pixel)
    return min(max(mix, 0.0), 1.0), shade
