"""Kernels of the lighting of surface points: hemisphere light, head light, lamps with or without shadow maps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.render.jit import color_inline, color_kernel

LAMP_REACH = 2.4
"""Distance [m] at which the light of a lamp has fallen to 0.35 of that at the lamp, by inverse-square falloff."""
LAMP_RANGE = 7.0
"""Distance [m] beyond which a lamp gives no light, so that images without shadows do not light rooms behind walls."""
SHADOW_SLOPE = 0.2
"""Cosine of the half field of view (78.5 deg) of shadow maps, which look straight down from the lamps."""
SKY = (0.36, 0.38, 0.42)
"""Ambient light, linear rgb, of a surface that faces up."""
GROUND = (0.25, 0.215, 0.185)
"""Ambient light, linear rgb, of a surface that faces down."""
HEAD_LIGHT = 0.10
"""Light of a lamp at the camera on a surface that faces it."""
LAMP_GAIN = 0.85
"""Exposure of lamps, chosen so that a white floor 2.4 m below a lamp of intensity 1 is bright but not clipped."""
UNMAPPED = 0.65
"""Visibility (0..1) of a lamp that is assumed at points outside of its shadow map (upper walls)."""
DULL = 0.05
"""Surfaces up to this gloss have no highlights."""


class Lamps(NamedTuple):
    """Lamps of all homes: pos (H, L, 3) [m], color (H, L, 3) linear rgb times intensity; shadow (L, S, S) f32: shadow
    maps (inverse depth [1/m], looking straight down) of the lamps of the home being drawn, or (0, 1, 1) for none."""

    pos: np.ndarray
    color: np.ndarray
    shadow: np.ndarray


@color_kernel
def _visible(shadow, k, x, y, z, nx, ny, nz):
    """Fraction 0..1 of light that reaches the point (x, y, z) [m] from lamp ``k`` at the origin.

    Filters 4 x 4 texels of the shadow map (percentage-closer filtering). Each texel is compared with the plane of the
    surface, whose normal is (nx, ny, nz), to avoid self-shadowing.
    """
    depth = -z
    size = shadow.shape[1]
    far = SHADOW_SLOPE * np.sqrt(x * x + y * y + z * z)
    if depth <= 0.02 or depth <= far:
        return UNMAPPED
    inv_focal = np.sqrt(1.0 - SHADOW_SLOPE * SHADOW_SLOPE) / (0.5 * size * SHADOW_SLOPE)
    w = 1.0 / depth
    u = 0.5 * size + x * w / inv_focal - 0.5
    v = 0.5 * size - y * w / inv_focal - 0.5
    if u < 1.0 or v < 1.0 or u > size - 3.0 or v > size - 3.0:
        return UNMAPPED
    i = int(v)
    j = int(u)
    fy = v - i
    fx = u - j
    plane = min(x * nx + y * ny + z * nz, -0.02 * depth)
    steep = 0.5 * w
    gx = min(max(nx / plane * inv_focal, -steep), steep)
    gy = min(max(-ny / plane * inv_focal, -steep), steep)
    limit = w * (1.0 + 0.01 * w + 0.006) - gx * (1.0 + fx) - gy * (1.0 + fy)
    lit = 0.0
    for r in range(4):
        wy = (1.0 - fy) if r == 0 else (fy if r == 3 else 1.0)
        for c in range(4):
            wx = (1.0 - fx) if c == 0 else (fx if c == 3 else 1.0)
            if shadow[k, i + r - 1, j + c - 1] < limit + gx * c + gy * r:
                lit += wx * wy
    lit *= 1.0 / 9.0
    edge = min((depth / far - 1.0) * 2.0, 1.0)
    return UNMAPPED + (lit - UNMAPPED) * edge


@color_inline
def _highlight(nx, ny, nz, lx, ly, lz, vx, vy, vz, gloss):
    """Specular factor of a lamp in direction l, seen from direction v, on a surface with normal n (unit vectors)."""
    hx = lx + vx
    hy = ly + vy
    hz = lz + vz
    h = (nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz + 1e-9)
    h2 = h * h
    h4 = h2 * h2
    h16 = h4 * h4 * h4 * h4
    return gloss * ((1.0 - gloss) * h16 + gloss * 2.0 * h16 * h16 * h16 * h16)


@color_inline
def light_point(lamps, home, x, y, z, nx, ny, nz, vx, vy, vz, gloss, open_share):
    """Compute the light on a surface point: diffuse rgb, a factor on its colour, and specular rgb, to be added.

    (x, y, z) [m] is the point, (nx, ny, nz) its unit normal, (vx, vy, vz) the unit vector to the camera, all in the
    world; ``gloss`` 0..1; ``open_share`` ambient openness 0..1 (1: not occluded).
    """
    dr = 0.0
    dg = 0.0
    db = 0.0
    sr = 0.0
    sg = 0.0
    sb = 0.0
    for k in range(lamps.pos.shape[1]):
        r = lamps.color[home, k, 0]
        g = lamps.color[home, k, 1]
        b = lamps.color[home, k, 2]
        lx = lamps.pos[home, k, 0] - x
        ly = lamps.pos[home, k, 1] - y
        lz = lamps.pos[home, k, 2] - z
        square = lx * lx + ly * ly + lz * lz
        facing = nx * lx + ny * ly + nz * lz
        if facing <= 0.0 or square > LAMP_RANGE * LAMP_RANGE or r + g + b == 0.0:
            continue
        inv = 1.0 / np.sqrt(square + 1e-9)
        fade = 1.0 - square * square * (1.0 / LAMP_RANGE**4)
        power = (
            LAMP_GAIN * facing * inv * fade / (0.35 + (0.65 / (LAMP_REACH * LAMP_REACH)) * square)
        )
        if lamps.shadow.shape[0] > 0:
            power *= _visible(
                lamps.shadow, k, 0.01 * nx - lx, 0.01 * ny - ly, 0.01 * nz - lz, nx, ny, nz
            )
        shine = 0.0
        if gloss > DULL:
            shine = power * _highlight(nx, ny, nz, lx * inv, ly * inv, lz * inv, vx, vy, vz, gloss)
        dr = dr + r * power
        dg = dg + g * power
        db = db + b * power
        sr = sr + r * shine
        sg = sg + g * shine
        sb = sb + b * shine
    facing = max(nx * vx + ny * vy + nz * vz, 0.0)
    side = open_share * (1.0 + 0.10 * nx + 0.05 * ny)
    away = 1.0 - facing
    rim = gloss * 0.25 * away * away * away * away * open_share
    up = (0.5 + 0.5 * nz) * side
    down = (0.5 - 0.5 * nz) * side
    head = HEAD_LIGHT * facing
    direct = 0.35 + 0.65 * open_share
    return (
        GROUND[0] * down + SKY[0] * up + dr * direct + head,
        GROUND[1] * down + SKY[1] * up + dg * direct + head,
        GROUND[2] * down + SKY[2] * up + db * direct + head,
        sr * open_share + rim * SKY[0],
        sg * open_share + rim * SKY[1],
        sb * open_share + rim * SKY[2],
    )


@color_inline
def sky(lens, u, v, line, x):
    """Write the background colour, linear rgb, along the ray with slopes (u right, v up) into ``line[:, x]``."""
    m = lens.mat
    dz = (m[2, 0] * u + m[2, 1] * v - m[2, 2]) / np.sqrt(1.0 + u * u + v * v)
    t = min(max(0.5 + 0.9 * dz, 0.0), 1.0)
    line[0, x] = 0.30 + 0.28 * t
    line[1, x] = 0.34 + 0.32 * t
    line[2, x] = 0.40 + 0.38 * t


@color_inline
def blended_share(share, depths, row, col, depth):
    """Ambient openness at a position (row, col in cells): bilateral interpolation of ``share`` (a, b).

    The four nearest cells are weighted by distance and by how well ``depths`` (a, b), inverse depth [1/m], matches
    ``depth`` [m].
    """
    height, width = share.shape
    fy = max(row - 0.5, 0.0)
    fx = max(col - 0.5, 0.0)
    i = min(int(fy), height - 1)
    j = min(int(fx), width - 1)
    fy = fy - i
    fx = fx - j
    total = 0.0
    weight = 1e-9
    for r in range(2):
        for c in range(2):
            y = min(i + r, height - 1)
            x = min(j + c, width - 1)
            w = (fy if r else 1.0 - fy) * (fx if c else 1.0 - fx) + 1e-3
            w *= 1e-4 + max(0.0, 1.0 - 20.0 * abs(depths[y, x] * depth - 1.0))
            total += w * share[y, x]
            weight += w
    return total / weight
