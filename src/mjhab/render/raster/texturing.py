"""Kernels of textured colours: patterns mapped by planar projection along an instance's axes, and images by uv.

``f`` are the frames of `surfaces.fill_frame`; (u, v) are the slopes of a pixel's ray. As with nodes, reading texels
stands in a loop of its own.
"""

from __future__ import annotations

import numpy as np

from mjhab.render.jit import color_inline
from mjhab.render.raster.lighting import SLANT
from mjhab.render.raster.nodes import (
    ACROSS,
    DEPTH,
    DOWN,
    FACE,
    INSTANCE,
    MATERIAL,
    NODE,
    PIXEL_ROW,
    ROW,
    SHORT_RUN,
    SLOT,
    START,
    TEXEL_B,
    TEXEL_G,
    TEXEL_R,
    column_shift,
    slope_down,
)
from mjhab.render.raster.surfaces import normal_at, place_point
from mjhab.render.textures import blended_byte, copy_for, texels_around

VECTOR = 8
"""Pixels that a loop over a segment computes at least: those beyond its end are overwritten by what follows."""
_CORNERS = tuple(np.uint64(corner * PIXEL_ROW) for corner in range(4))
_HALF = np.float32(0.5)


@color_inline
def _pattern_axes(surface, i, face, f, u, v, depth):
    """Axes (0..2) of the instance that u and v of a pattern run along, for a face of instance ``i``.

    They span the coordinate plane most parallel to the face; u runs along the longer side of the instance.
    """
    x, y, z = place_point(f, i, u, v, depth)
    x, y, z = normal_at(surface, f, i, face, x, y, z)
    x = abs(x)
    y = abs(y)
    z = abs(z)
    across = 0 if x >= y else 1
    across = 2 if z >= max(x, y) else across
    first = np.uint64(f[i, 24 + across])
    return first, np.uint64(3 - across) - first


@color_inline
def _along(f, i, axis, v, scale):
    """Coordinate along an axis of instance ``i`` of a pixel at depth d and slope u: ``a + d * (b * u + c)``, scaled."""
    ray = np.uint64(3) + np.uint64(3) * axis
    ahead = f[i, ray + np.uint64(1)] * v - f[i, ray + np.uint64(2)]
    return f[i, axis] * scale, f[i, ray] * scale, ahead * scale


@color_inline
def _texture_map(surface, f, i, face, m, u, v, depth):
    """Map from the pixels of a run to the coordinates (s, t) of the texture of material ``m``.

    ``u``, ``depth``: of one pixel of the run. A pixel with the slope u at a depth d has ``s = s0 + d * (su * u + sc)``,
    and t likewise.

    Returns:
        s0, su, sc, t0, tu, tc.
    """
    if surface.pattern[m]:
        first, second = _pattern_axes(surface, i, face, f, u, v, depth)
        s0, su, sc = _along(f, i, first, v, surface.periods[m, 0])
        t0, tu, tc = _along(f, i, second, v, surface.periods[m, 1])
        # Every instance has another offset in the pattern.
        return s0 + 0.37 * i, su, sc, t0 + 0.23 * i, tu, tc
    ox, ax, cx = _along(f, i, np.uint64(0), v, f[i, 12])
    oy, ay, cy = _along(f, i, np.uint64(1), v, f[i, 13])
    oz, az, cz = _along(f, i, np.uint64(2), v, f[i, 14])
    e = surface.face_uv
    return (
        e[face, 0, 0] * ox + e[face, 0, 1] * oy + e[face, 0, 2] * oz + e[face, 0, 3],
        e[face, 0, 0] * ax + e[face, 0, 1] * ay + e[face, 0, 2] * az,
        e[face, 0, 0] * cx + e[face, 0, 1] * cy + e[face, 0, 2] * cz,
        e[face, 1, 0] * ox + e[face, 1, 1] * oy + e[face, 1, 2] * oz + e[face, 1, 3],
        e[face, 1, 0] * ax + e[face, 1, 1] * ay + e[face, 1, 2] * az,
        e[face, 1, 0] * cx + e[face, 1, 1] * cy + e[face, 1, 2] * cz,
    )


@color_inline
def _place_segment(scratch, left, count, slot, start, wide, high, across, down):
    """Find the texels of ``count`` pixels from ``left``, and write them from ``slot`` on.

    ``across`` and ``down`` map to texels: of a pixel p at a depth d ``a + d * (b * p + c)``.
    """
    pixels = scratch.pixels
    texel_at = scratch.texel_at
    a, b, c = across
    d, e, f = down
    for k in range(np.uint64(count)):
        depth = pixels[left + k + DEPTH]
        p = np.float32(np.int32(k))
        x = a + depth * (b * p + c)
        y = d + depth * (e * p + f)
        t00, t01, t10, t11, right, below = texels_around(x, y, start, wide, high)
        texel_at[slot + k + _CORNERS[0]] = t00
        texel_at[slot + k + _CORNERS[1]] = t01
        texel_at[slot + k + _CORNERS[2]] = t10
        texel_at[slot + k + _CORNERS[3]] = t11
        pixels[slot + k + ACROSS] = right
        pixels[slot + k + DOWN] = below


@color_inline
def _place_run(surface, lens, shape, stripe, scratch, run, slot, stride):
    """Find the texels of a textured run, and write them from ``slot`` on; returns the next slot."""
    runs = scratch.runs
    f = scratch.frames
    inv = 1.0 / lens.focal
    row = runs[run, ROW]
    start = runs[run, START]
    stop = runs[run + np.uint64(1), START]
    face = np.uint64(runs[run, FACE])
    m = np.uint64(runs[run, MATERIAL])
    n = np.uint64(runs[run, NODE])
    i = np.uint64(runs[run, INSTANCE])
    runs[run, SLOT] = slot
    shift = column_shift(shape, stripe, row)
    short = stop - start <= SHORT_RUN
    at = (start + stop) // 2 if short else start
    u = (at + shift) * inv
    depth = scratch.pixels[np.uint64(at) + DEPTH]
    v = slope_down(lens, shape, stripe, row)
    s0, su, sc, t0, tu, tc = _texture_map(surface, f, i, face, m, u, v, depth)
    # The texture repeats: near 0 there are most digits of float32.
    s0 -= np.floor(s0 + depth * (su * u + sc))
    t0 -= np.floor(t0 + depth * (tu * u + tc))
    density = surface.density[m] * inv
    if not surface.pattern[m]:
        density *= surface.face_density[face] * f[i, 27]
    texture = np.uint64(surface.texture[m])
    texels = surface.texels
    left = start
    while left < stop:
        end = stop if short or left + stride >= stop - 1 else left + stride
        depth = scratch.pixels[np.uint64(left) + DEPTH]
        slant = scratch.nodes[n + SLANT]
        level = np.uint64(copy_for(slant * depth * np.float32(density)))
        wide = np.int32(max(texels.bits[texture, 0] - np.int64(level), 0))
        high = np.int32(max(texels.bits[texture, 1] - np.int64(level), 0))
        width = float(1 << wide)
        height = float(1 << high)
        first = (left + shift) * inv
        _place_segment(
            scratch,
            np.uint64(left),
            (end - left + VECTOR - 1) // VECTOR * VECTOR,
            np.uint64(slot),
            np.int32(texels.start[texture, level]),
            wide,
            high,
            (
                np.float32(s0 * width) - _HALF,
                np.float32(su * inv * width),
                np.float32((su * first + sc) * width),
            ),
            (
                np.float32(t0 * height) - _HALF,
                np.float32(tu * inv * height),
                np.float32((tu * first + tc) * height),
            ),
        )
        slot += end - left
        left = end
        n += np.uint64(1)
    return slot


@color_inline
def read_textures(surface, lens, shape, stripe, scratch, count, stride):
    """Fill rows TEXEL_R, TEXEL_G, TEXEL_B for the first ``count`` textured runs, and SLOT of these."""
    slots = 0
    for k in range(np.uint64(count)):
        run = np.uint64(scratch.textured[k])
        slots = _place_run(surface, lens, shape, stripe, scratch, run, slots, stride)
    every = range(np.uint64(slots))
    texel_at = scratch.texel_at
    texels = surface.texels.pixels
    for corner in range(4):
        first = np.uint64(corner * PIXEL_ROW)
        for k in every:
            texel_at[first + k] = np.int32(texels[np.uint64(texel_at[first + k])])
    pixels = scratch.pixels
    for k in every:
        p00 = texel_at[k + _CORNERS[0]]
        p01 = texel_at[k + _CORNERS[1]]
        p10 = texel_at[k + _CORNERS[2]]
        p11 = texel_at[k + _CORNERS[3]]
        across = pixels[k + ACROSS]
        down = pixels[k + DOWN]
        pixels[k + TEXEL_R] = blended_byte(p00, p01, p10, p11, across, down, 0)
        pixels[k + TEXEL_G] = blended_byte(p00, p01, p10, p11, across, down, 8)
        pixels[k + TEXEL_B] = blended_byte(p00, p01, p10, p11, across, down, 16)
