"""Kernels of textured colours: the texels of the pixels of patterns and images.

As with nodes, reading texels stands in a loop of its own.
"""

from __future__ import annotations

import numpy as np

from mjhab.render.jit import color_inline
from mjhab.render.lanes import LANES, lanes_at, lanes_from, put_lanes
from mjhab.render.raster.faces import DENSITY, TEXTURE, S, T
from mjhab.render.raster.lighting import SLANT
from mjhab.render.raster.nodes import (
    ACROSS,
    DEPTH,
    DOWN,
    FACE,
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
from mjhab.render.textures import blended_byte, copy_for, texels_around

_CORNERS = tuple(np.uint64(corner * PIXEL_ROW) for corner in range(4))
_HALF = np.float32(0.5)


@color_inline
def _along_run(numbers, face, first, v):
    """Map from a run's slopes u at depths d to a texture coordinate, ``a + d * (b * u + c)``, from column ``first``."""
    a = np.float64(numbers[face + first])
    b = np.float64(numbers[face + first + np.uint64(1)])
    c = np.float64(numbers[face + first + np.uint64(2)])
    return a, b, c * v + numbers[face + first + np.uint64(3)]


@color_inline
def _place_segment(scratch, left, count, slot, start, wide, high, across, down):
    """Find the texels of ``count`` pixels from ``left``, and write them from ``slot`` on.

    What stands behind the last is overwritten; texels of pixels that follow come there later.

    ``across`` and ``down`` map to texels: of a pixel p at a depth d ``a + d * (b * p + c)``.
    """
    pixels = scratch.pixels
    texel_at = scratch.texel_at
    a, b, c = across
    d, e, f = down
    for done in range(0, count, LANES):
        depth = lanes_at(pixels, left + np.uint64(done) + DEPTH)
        p = lanes_from(np.int32(done))
        at = slot + np.uint64(done)
        t00, t01, t10, t11, right, below = texels_around(
            a + depth * (b * p + c), d + depth * (e * p + f), start, wide, high
        )
        put_lanes(texel_at, at + _CORNERS[0], t00)
        put_lanes(texel_at, at + _CORNERS[1], t01)
        put_lanes(texel_at, at + _CORNERS[2], t10)
        put_lanes(texel_at, at + _CORNERS[3], t11)
        put_lanes(pixels, at + ACROSS, right)
        put_lanes(pixels, at + DOWN, below)


@color_inline
def _place_run(surface, lens, shape, stripe, scratch, run, slot, stride):
    """Find the texels of a textured run, and write them from ``slot`` on; returns the next slot."""
    runs = scratch.runs
    numbers = scratch.faces.numbers
    inv = 1.0 / lens.focal
    row = np.int64(runs[run + ROW])
    start = np.int64(runs[run + START])
    stop = np.int64(runs[run + np.uint64(1) + START])
    face = np.uint64(runs[run + FACE])
    n = np.uint64(runs[run + NODE])
    runs[run + SLOT] = slot
    shift = column_shift(shape, stripe, row)
    short = stop - start <= SHORT_RUN
    at = (start + stop) // 2 if short else start
    u = (at + shift) * inv
    depth = scratch.pixels[np.uint64(at) + DEPTH]
    v = slope_down(inv, shape, stripe, row)
    s0, su, sc = _along_run(numbers, face, S, v)
    t0, tu, tc = _along_run(numbers, face, T, v)
    # The texture repeats: near 0 there are most digits of float32.
    s0 -= np.floor(s0 + depth * (su * u + sc))
    t0 -= np.floor(t0 + depth * (tu * u + tc))
    density = np.float32(numbers[face + DENSITY])
    texture = np.uint64(numbers[face + TEXTURE])
    texels = surface.texels
    left = start
    while left < stop:
        end = stop if short or left + stride >= stop - 1 else left + stride
        depth = scratch.pixels[np.uint64(left) + DEPTH]
        slant = scratch.nodes[n + SLANT]
        level = np.uint64(copy_for(slant * depth * density))
        wide = np.int32(max(texels.bits[texture, 0] - np.int64(level), 0))
        high = np.int32(max(texels.bits[texture, 1] - np.int64(level), 0))
        width = float(1 << wide)
        height = float(1 << high)
        first = (left + shift) * inv
        _place_segment(
            scratch,
            np.uint64(left),
            end - left,
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
