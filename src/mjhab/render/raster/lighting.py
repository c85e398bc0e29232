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
MAP_EDGE = 4.6
"""Largest slope (horizontal by vertical distance from the lamp) looked up in a shadow map, whose edge is at 4.9. Points
above this cone (upper walls, ceilings) are taken for points on it, so that no shadow and no light ends in a
horizontal band."""
TALL_GAP = 0.8
"""What stands this far in front of such a point [m] is a wall and casts its shadow up to the ceiling; the shadows of
what is near, such as cups on a shelf before the wall, fade on the way up to the height of the lamp."""
DULL = 0.05
"""Surfaces up to this gloss have no highlights."""


MOST_NODES = 512
"""Most points at which light is computed together."""
NODE_ROW = MOST_NODES + 16
"""Length of a row of ``nodes``, a flat f32 array with one number per node in each row. The rows are the point X, Y, Z
[m], the unit normal NX, NY, NZ and the unit vector to the camera VX, VY, VZ in the world; GLOSS 0..1; OPEN, ambient
openness 0..1 (1: not occluded); FACING, cosine between normal and camera; LIT, share of a lamp's light that arrives;
DR, DG, DB, diffuse light, a factor on the colour; SR, SG, SB, specular light, to be added; SLANT, length on the surface
that a pixel covers, relative to one that faces the camera.

The array is flat and its rows have a constant length: only then the compiler knows that rows do not overlap, and
vectorises loops over nodes. The 16 keep rows from falling on the same lines of the processor's cache."""
NODE_ROWS = 20
(
    X, Y, Z, NX, NY, NZ, VX, VY, VZ, GLOSS, OPEN, FACING, LIT, DR, DG, DB, SR, SG, SB, SLANT,
) = (np.uint64(row * NODE_ROW) for row in range(NODE_ROWS))  # fmt: skip
_TINY = np.float32(1e-9)
_FADE = np.float32(1.0 / LAMP_RANGE**4)
_GAIN = np.float32(LAMP_GAIN)
_AT_LAMP = np.float32(0.35)
_FALL = np.float32(0.65 / LAMP_REACH**2)
_FAINT = np.float32(0.1)
_DULL = np.float32(DULL)
_HEAD = np.float32(HEAD_LIGHT)
_SKY_R, _SKY_G, _SKY_B = (np.float32(level) for level in SKY)
_GROUND_R, _GROUND_G, _GROUND_B = (np.float32(level) for level in GROUND)


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
    size = shadow.shape[1]
    depth = max(-z, np.sqrt(x * x + y * y) / MAP_EDGE)
    if depth <= 0.02:
        return 1.0
    inv_focal = np.sqrt(1.0 - SHADOW_SLOPE * SHADOW_SLOPE) / (0.5 * size * SHADOW_SLOPE)
    w = 1.0 / depth
    u = 0.5 * size + x * w / inv_focal - 0.5
    v = 0.5 * size - y * w / inv_focal - 0.5
    i = int(v)
    j = int(u)
    fy = v - i
    fx = u - j
    plane = min(x * nx + y * ny - depth * nz, -0.02 * depth)
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
    level = max(-z, 0.0) / depth
    if level < 1.0 and lit < 1.0:
        above = 1.0 - level * level * level
        gap = np.sqrt(x * x + y * y) * (1.0 - w / max(shadow[k, i + 1, j + 1], w))
        lit += (1.0 - lit) * above * (1.0 - min(gap / TALL_GAP, 1.0))
    return lit


@color_inline
def _lit(shadow, k, nodes, n, lamp_x, lamp_y, lamp_z):
    """Share of the light of lamp ``k`` at (lamp_x, lamp_y, lamp_z) that reaches node ``n``, by its shadow map."""
    nx = nodes[n + NX]
    ny = nodes[n + NY]
    nz = nodes[n + NZ]
    x = nodes[n + X] - lamp_x
    y = nodes[n + Y] - lamp_y
    z = nodes[n + Z] - lamp_z
    return _visible(shadow, k, 0.01 * nx + x, 0.01 * ny + y, 0.01 * nz + z, nx, ny, nz)


@color_inline
def _add_lamp(lamps, home, k, nodes, count, every):
    """Add the light of lamp ``k`` to the rows DR to SB, diffuse and highlights. It uses the row LIT."""
    zero = np.float32(0.0)
    one = np.float32(1.0)
    r = np.float32(lamps.color[home, k, 0])
    g = np.float32(lamps.color[home, k, 1])
    b = np.float32(lamps.color[home, k, 2])
    if r + g + b == zero:
        return
    lamp_x = np.float32(lamps.pos[home, k, 0])
    lamp_y = np.float32(lamps.pos[home, k, 1])
    lamp_z = np.float32(lamps.pos[home, k, 2])
    if lamps.shadow.shape[0] > 0:
        for n in range(np.uint64(count)):
            nodes[n + LIT] = _lit(lamps.shadow, k, nodes, n, lamp_x, lamp_y, lamp_z)
    for n in every:
        nx = nodes[n + NX]
        ny = nodes[n + NY]
        nz = nodes[n + NZ]
        lx = lamp_x - nodes[n + X]
        ly = lamp_y - nodes[n + Y]
        lz = lamp_z - nodes[n + Z]
        square = lx * lx + ly * ly + lz * lz
        inv = one / np.sqrt(square + _TINY)
        lx = lx * inv
        ly = ly * inv
        lz = lz * inv
        facing = max(nx * lx + ny * ly + nz * lz, zero)
        # 0 from LAMP_RANGE on.
        fade = max(one - square * square * _FADE, zero)
        power = _GAIN * facing * fade * nodes[n + LIT] / (_AT_LAMP + _FALL * square)
        hx = lx + nodes[n + VX]
        hy = ly + nodes[n + VY]
        hz = lz + nodes[n + VZ]
        h = (nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz + _TINY)
        # Smaller cosines give no visible highlight, and their powers are denormal numbers, which are slow.
        h2 = max(h * h, _FAINT)
        h4 = h2 * h2
        h16 = h4 * h4 * h4 * h4
        h64 = h16 * h16 * h16 * h16
        gloss = nodes[n + GLOSS]
        shine = power * gloss * ((one - gloss) * h16 + (gloss + gloss) * h64)
        shine = shine if gloss > _DULL else zero
        nodes[n + DR] += r * power
        nodes[n + DG] += g * power
        nodes[n + DB] += b * power
        nodes[n + SR] += r * shine
        nodes[n + SG] += g * shine
        nodes[n + SB] += b * shine


@color_inline
def _add_surroundings(nodes, every):
    """Add the light of sky, ground and viewer; cavities take some of it, and of what lamps gave."""
    zero = np.float32(0.0)
    one = np.float32(1.0)
    half = np.float32(0.5)
    for n in every:
        nz = nodes[n + NZ]
        share = nodes[n + OPEN]
        facing = max(nodes[n + FACING], zero)
        away = one - facing
        away = away * away
        rim = nodes[n + GLOSS] * np.float32(0.25) * away * away * share
        side = share * (
            one + np.float32(0.10) * nodes[n + NX] + np.float32(0.05) * nodes[n + NY]
        )
        up = (half + half * nz) * side
        down = (half - half * nz) * side
        head = _HEAD * facing
        direct = np.float32(0.35) + np.float32(0.65) * share
        nodes[n + DR] = _GROUND_R * down + _SKY_R * up + nodes[n + DR] * direct + head
        nodes[n + DG] = _GROUND_G * down + _SKY_G * up + nodes[n + DG] * direct + head
        nodes[n + DB] = _GROUND_B * down + _SKY_B * up + nodes[n + DB] * direct + head
        nodes[n + SR] = nodes[n + SR] * share + rim * _SKY_R
        nodes[n + SG] = nodes[n + SG] * share + rim * _SKY_G
        nodes[n + SB] = nodes[n + SB] * share + rim * _SKY_B


@color_inline
def light_nodes(lamps, home, nodes, count):
    """Compute the light on the first ``count`` nodes, see `NODE_ROW`: rows DR to SB from the rows X to OPEN.

    Every loop over nodes runs without branches and in float32, so that the compiler computes eight nodes at a time.
    """
    zero = np.float32(0.0)
    one = np.float32(1.0)
    # Whole vectors: a loop over the nodes that are left over would take as long as one over eight.
    every = range(np.uint64((count + 7) // 8 * 8))
    for n in every:
        nodes[n + LIT] = one
        nodes[n + DR] = zero
        nodes[n + DG] = zero
        nodes[n + DB] = zero
        nodes[n + SR] = zero
        nodes[n + SG] = zero
        nodes[n + SB] = zero
    for k in range(lamps.pos.shape[1]):
        _add_lamp(lamps, home, k, nodes, count, every)
    _add_surroundings(nodes, every)
