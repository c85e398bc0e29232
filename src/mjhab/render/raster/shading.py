"""Kernels of deferred shading: the colour of every pixel from the ids and inverse depths of the z-buffer.

An image is shaded in stripes of some rows, in runs of pixels on one face. Light varies slowly along a run: it is
computed every few pixels (at nodes), for all nodes of a stripe at once, and interpolated linearly; textures are sampled
at every pixel. Light is linear rgb until ``tone_curve``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.render.jit import color_inline, color_kernel
from mjhab.render.lanes import LANES, lanes_at, lanes_from, put_lanes
from mjhab.render.patterns import SHADE_TOP
from mjhab.render.raster.faces import (
    COLOR,
    KIND,
    MOST_FACES,
    OTHER,
    PATTERN,
    PLAIN,
    FaceViews,
    forget_faces,
    make_face_views,
)
from mjhab.render.raster.lighting import (
    DB,
    DG,
    DR,
    MOST_NODES,
    NODE_ROW,
    NODE_ROWS,
    SB,
    SG,
    SR,
    light_nodes,
)
from mjhab.render.raster.nodes import (
    FACE,
    LINE_B,
    LINE_G,
    LINE_R,
    NODE,
    PIXEL_ROW,
    PIXEL_ROWS,
    ROW,
    RUN_ROW,
    RUN_ROWS,
    SHORT_RUN,
    SLOT,
    START,
    Stripe,
    aim_nodes,
    column_shift,
    find_runs,
    place_nodes,
    read_pixels,
    slope_down,
)
from mjhab.render.raster.texturing import (
    TEXEL_B,
    TEXEL_G,
    TEXEL_R,
    read_textures,
)
from mjhab.scenes.shapes.colors import linear_to_srgb

TONE_RANGE = 4.0
"""Linear light of the last entry of ``tone_curve``; larger values are clipped."""
_LIGHT = DR, DG, DB, SR, SG, SB
_BYTE = np.float32(1.0 / 255.0)
_SHADE = np.float32(SHADE_TOP / 255.0)
_CUBIC = np.float32(0.305306011)
_SQUARE = np.float32(0.682171111)
_LINEAR = np.float32(0.012522878)
_NEXT = np.uint64(1)


class ShadeScratch(NamedTuple):
    """Working memory of one thread.

    Attributes:
        total: (3, width) f32, sums of linear rgb over the samples of each pixel.
        frames: (I, 28) f64, see `surfaces.fill_frame`; entry i is valid if ``stamp[i] == stamp[-1]``.
        stamp: (I + 1,) i64, number of the image that ``frames`` was filled for; the last entry is the current image.
        faces: how the camera sees the faces of the image.
        runs: i32, the runs of a stripe and the end of the last, see `nodes.START`.
        textured: (MOST_NODES + 1,) i64, the textured runs.
        keys: (PIXEL_ROW,) i32, ids of the pixels of a stripe, -1 for the background.
        cell_at: (2 * MOST_NODES,) i32, row and column of a cell of ambient occlusion at each node.
        texel_at: (4 * PIXEL_ROW,) i32, indices of the four texels of textured pixels, then these.
        pixels: f32, the pixels of a stripe, see `nodes.PIXEL_ROW`.
        nodes: f32, the nodes of its runs, see `lighting.NODE_ROW`.
    """

    total: np.ndarray
    frames: np.ndarray
    stamp: np.ndarray
    faces: FaceViews
    runs: np.ndarray
    textured: np.ndarray
    keys: np.ndarray
    cell_at: np.ndarray
    texel_at: np.ndarray
    pixels: np.ndarray
    nodes: np.ndarray


def make_shade_scratch(instances: int, width: int) -> ShadeScratch:
    """Allocate the scratch of one thread for I instances and rows of up to ``width`` samples."""
    return ShadeScratch(
        np.empty((3, width), np.float32),
        np.empty((instances, 28)),
        np.zeros(instances + 1, np.int64),
        make_face_views(),
        np.empty(RUN_ROWS * RUN_ROW, np.int32),
        np.empty(MOST_NODES + 1, np.int64),
        np.empty(PIXEL_ROW, np.int32),
        np.empty(2 * MOST_NODES, np.int32),
        np.empty(4 * PIXEL_ROW, np.int32),
        np.zeros(PIXEL_ROWS * PIXEL_ROW, np.float32),
        np.zeros(NODE_ROWS * NODE_ROW, np.float32),
    )


def tone_curve(entries: int = 16384) -> np.ndarray:
    """Compute the tone map: (entries,) uint8 sRGB over linear light 0..`TONE_RANGE`, compressed above 0.6."""
    linear = compressed(np.linspace(0.0, TONE_RANGE, entries))
    return np.round(255.0 * linear_to_srgb(linear)).astype(np.uint8)


def compressed(linear: np.ndarray) -> np.ndarray:
    """Linear light 0 to infinity (any shape) in 0..1: up to 0.6 as it is, smoothly less above."""
    over = np.maximum(linear - 0.6, 0.0)
    return np.minimum(linear, 0.6) + 0.4 * (1.0 - np.exp(-over / 0.4))


@color_inline
def _light_at(nodes, n):
    """Light of node ``n``: diffuse rgb, specular rgb."""
    return (
        nodes[n + DR],
        nodes[n + DG],
        nodes[n + DB],
        nodes[n + SR],
        nodes[n + SG],
        nodes[n + SB],
    )


@color_inline
def _fill_plain(pixels, left, count, color, p, d):
    """Write ``count`` pixels from ``left`` with a colour; light is ``p`` at ``left`` and changes by ``d`` per pixel."""
    r0 = color[0] * p[0] + p[3]
    g0 = color[1] * p[1] + p[4]
    b0 = color[2] * p[2] + p[5]
    r1 = color[0] * d[0] + d[3]
    g1 = color[1] * d[1] + d[4]
    b1 = color[2] * d[2] + d[5]
    for done in range(0, count, LANES):
        at = left + np.uint64(done)
        t = lanes_from(np.int32(done))
        put_lanes(pixels, at + LINE_R, r0 + t * r1)
        put_lanes(pixels, at + LINE_G, g0 + t * g1)
        put_lanes(pixels, at + LINE_B, b0 + t * b1)


@color_inline
def _fill_pattern(pixels, left, count, slot, color, change, p, d):
    """As `_fill_plain`, with a share of ``change`` added to the colour and a shade, as texels from ``slot`` on tell."""
    for done in range(0, count, LANES):
        at = left + np.uint64(done)
        texel = slot + np.uint64(done)
        t = lanes_from(np.int32(done))
        mix = lanes_at(pixels, texel + TEXEL_R) * _BYTE
        shade = lanes_at(pixels, texel + TEXEL_G) * _SHADE
        r = shade * (color[0] + mix * change[0])
        g = shade * (color[1] + mix * change[1])
        b = shade * (color[2] + mix * change[2])
        put_lanes(pixels, at + LINE_R, r * (p[0] + t * d[0]) + (p[3] + t * d[3]))
        put_lanes(pixels, at + LINE_G, g * (p[1] + t * d[1]) + (p[4] + t * d[4]))
        put_lanes(pixels, at + LINE_B, b * (p[2] + t * d[2]) + (p[5] + t * d[5]))


@color_inline
def _linear(level):
    """Linear light 0..1 of an sRGB value 0..255 (cubic approximation, error below 0.002)."""
    c = level * _BYTE
    return c * (c * (c * _CUBIC + _SQUARE) + _LINEAR)


@color_inline
def _fill_image(pixels, left, count, slot, color, p, d):
    """As `_fill_plain`, with a colour times that of the texels from ``slot`` on."""
    for done in range(0, count, LANES):
        at = left + np.uint64(done)
        texel = slot + np.uint64(done)
        t = lanes_from(np.int32(done))
        r = color[0] * _linear(lanes_at(pixels, texel + TEXEL_R))
        g = color[1] * _linear(lanes_at(pixels, texel + TEXEL_G))
        b = color[2] * _linear(lanes_at(pixels, texel + TEXEL_B))
        put_lanes(pixels, at + LINE_R, r * (p[0] + t * d[0]) + (p[3] + t * d[3]))
        put_lanes(pixels, at + LINE_G, g * (p[1] + t * d[1]) + (p[4] + t * d[4]))
        put_lanes(pixels, at + LINE_B, b * (p[2] + t * d[2]) + (p[5] + t * d[5]))


@color_inline
def _fill_segment(pixels, look, left, count, slot, p, d):
    """Write the colours of ``count`` pixels from ``left`` of a face with the `_look`."""
    kind, color, change = look
    # Whole vectors are written: what lies beyond the end belongs to runs that follow, or is never read.
    if kind == PLAIN:
        _fill_plain(pixels, left, count, color, p, d)
    elif kind == PATTERN:
        _fill_pattern(pixels, left, count, slot, color, change, p, d)
    else:
        _fill_image(pixels, left, count, slot, color, p, d)


@color_inline
def _triple(numbers, face, first):
    """Three numbers of a face from the column ``first``, float32."""
    return (
        np.float32(numbers[face + first]),
        np.float32(numbers[face + first + np.uint64(1)]),
        np.float32(numbers[face + first + np.uint64(2)]),
    )


@color_inline
def _fill_run(scratch, run, start, stop, stride):
    """Write the colours of a run, from the light of its nodes and from its texels."""
    runs = scratch.runs
    nodes = scratch.nodes
    pixels = scratch.pixels
    numbers = scratch.faces.numbers
    face = np.uint64(runs[run + FACE])
    n = np.uint64(runs[run + NODE])
    slot = np.uint64(runs[run + SLOT])
    look = (
        numbers[face + KIND],
        _triple(numbers, face, COLOR),
        _triple(numbers, face, OTHER),
    )
    p = _light_at(nodes, n)
    if stop - start <= SHORT_RUN:
        zero = np.float32(0.0)
        d = (zero, zero, zero, zero, zero, zero)
        _fill_segment(pixels, look, np.uint64(start), stop - start, slot, p, d)
        return
    left = start
    while left < stop:
        at = min(left + stride, stop - 1)
        end = stop if at == stop - 1 else at
        n += _NEXT
        q = _light_at(nodes, n)
        s = np.float32(1.0) / np.float32(at - left)
        d = (
            (q[0] - p[0]) * s,
            (q[1] - p[1]) * s,
            (q[2] - p[2]) * s,
            (q[3] - p[3]) * s,
            (q[4] - p[4]) * s,
            (q[5] - p[5]) * s,
        )
        _fill_segment(pixels, look, np.uint64(left), end - left, slot, p, d)
        slot += np.uint64(end - left)
        left = end
        p = q


@color_inline
def _fill_sky(lens, shape, stripe, scratch, row, start, stop):
    """Write the colours of a run of the background."""
    m = lens.mat
    pixels = scratch.pixels
    shift = column_shift(shape, stripe, row)
    v = slope_down(1.0 / lens.focal, shape, stripe, row)
    for p in range(np.uint64(start), np.uint64(stop)):
        u = (np.float64(p) + shift) / lens.focal
        dz = (m[2, 0] * u + m[2, 1] * v - m[2, 2]) / np.sqrt(1.0 + u * u + v * v)
        t = min(max(0.5 + 0.9 * dz, 0.0), 1.0)
        pixels[p + LINE_R] = 0.30 + 0.28 * t
        pixels[p + LINE_G] = 0.34 + 0.32 * t
        pixels[p + LINE_B] = 0.40 + 0.38 * t


@color_inline
def _fill_runs(lens, shape, stripe, scratch, count, stride):
    """Write the colours of the first ``count`` runs, from left to right, because each may write beyond its end."""
    runs = scratch.runs
    for run in range(np.uint64(count)):
        start = np.int64(runs[run + START])
        stop = np.int64(runs[run + _NEXT + START])
        if runs[run + FACE] < 0:
            _fill_sky(
                lens, shape, stripe, scratch, np.int64(runs[run + ROW]), start, stop
            )
        else:
            _fill_run(scratch, run, start, stop, stride)


@color_inline
def _store(pixels, entries, total, s, stripe, row, tone, rgb):
    """Add a row of the stripe's samples to the sums of its pixels; after the last of a pixel, write tone-mapped rgb.

    ``s`` is the number of samples per pixel side; ``entries`` is scratch for indices into ``tone``.
    """
    y = (stripe.top + row) // s
    part = (stripe.top + row) % s
    first = np.uint64(stripe.begin // s)
    at = np.uint64(row * stripe.span)
    scale = np.float32((tone.shape[0] - 1) / (TONE_RANGE * s * s))
    zero = np.float32(0.0)
    top = np.float32(tone.shape[0] - 1)
    if s == 1:
        # Reading the table stands in a loop of its own, as with textures.
        for c in range(3):
            line = np.uint64(c * PIXEL_ROW)
            for k in range(np.uint64(stripe.span)):
                level = min(max(pixels[at + k + line + LINE_R] * scale, zero), top)
                entries[k + line] = np.int32(level)
        for k in range(np.uint64(stripe.span)):
            for c in range(3):
                entry = entries[k + np.uint64(c * PIXEL_ROW)]
                rgb[y, first + k, c] = tone[np.uint64(entry)]
        return
    for c in range(3):
        for k in range(np.uint64(stripe.span // s)):
            level = total[c, first + k] if part > 0 else zero
            for n in range(np.uint64(s)):
                place = at + k * np.uint64(s) + n
                level += pixels[place + np.uint64(c * PIXEL_ROW) + LINE_R]
            total[c, first + k] = level
            if part == s - 1:
                level = min(max(level * scale, zero), top)
                rgb[y, first + k, c] = tone[np.uint64(np.int32(level))]


@color_kernel
def shade(
    surface,
    poses,
    lamps,
    home,
    looks,
    lens,
    inverse,
    ids,
    openness,
    tone,
    scratch,
    stride,
    rgb,
):
    """Shade an image into ``rgb`` (h, w, 3) uint8 sRGB from the z-buffer, averaging s x s samples in linear light.

    Args:
        surface, lamps, tone: see `Surface`, `Lamps` and `tone_curve`.
        poses: the scratch that `kernels.draw` filled.
        home: index of the home.
        looks: (M,) i32, the material that each one is drawn as.
        lens: the camera; its focal length is in samples.
        inverse, ids: (s h, s w) f32 and i32, the z-buffer.
        openness: ambient occlusion of the z-buffer.
        scratch: working memory.
        stride: samples between nodes of light.
        rgb: output.
    """
    shape = inverse.shape
    rows, columns = shape
    s = rows // rgb.shape[0]
    scratch.stamp[-1] += 1
    forget_faces(scratch.faces)
    # A stripe has at most one node per pixel: some whole rows, or a part of a row in whole pixels of the output.
    height = max(MOST_NODES // columns, 1)
    width = min(columns, MOST_NODES // s * s)
    for top in range(0, rows, height):
        for begin in range(0, columns, width):
            stripe = Stripe(
                top, min(height, rows - top), begin, min(width, columns - begin)
            )
            if scratch.faces.count[0] > MOST_FACES - MOST_NODES:
                forget_faces(scratch.faces)
            read_pixels(inverse, ids, stripe, scratch)
            runs = find_runs(stripe, scratch)
            nodes, textured = place_nodes(
                surface, poses, home, looks, lens, shape, stripe, scratch, runs, stride
            )
            aim_nodes(lens, shape, openness, scratch, nodes)
            light_nodes(lamps, home, scratch.nodes, nodes)
            read_textures(surface, lens, shape, stripe, scratch, textured, stride)
            _fill_runs(lens, shape, stripe, scratch, runs, stride)
            for row in range(stripe.rows):
                _store(
                    scratch.pixels,
                    scratch.texel_at,
                    scratch.total,
                    s,
                    stripe,
                    row,
                    tone,
                    rgb,
                )
