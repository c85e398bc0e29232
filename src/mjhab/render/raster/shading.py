"""Kernels of deferred shading: the colour of every pixel from the ids and inverse depths of the z-buffer.

A row is shaded in runs of pixels on one face. Light varies slowly along a run: it is computed every few pixels (at
nodes), for all nodes of a row at once, and interpolated linearly; textures are sampled at every pixel. Light is linear
rgb until ``tone_curve``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.render.jit import color_inline, color_kernel
from mjhab.render.raster.arrays import FACE_BITS
from mjhab.render.raster.lighting import (
    DB,
    DG,
    DR,
    FACING,
    MOST_NODES,
    NODE_ROW,
    NODE_ROWS,
    SB,
    SG,
    SR,
    light_nodes,
    sky,
)
from mjhab.render.raster.nodes import (
    aim_nodes,
    openness_at,
    towards_camera,
    world_normal,
    write_node,
)
from mjhab.render.raster.surfaces import fill_frame
from mjhab.render.raster.texturing import texture_level, texture_map, textured
from mjhab.scenes.shapes.colors import linear_to_srgb

SHORT_RUN = 3
"""Runs up to this many samples have constant light, that of their middle."""
TONE_RANGE = 4.0
"""Linear light of the last entry of ``tone_curve``; larger values are clipped."""


class ShadeScratch(NamedTuple):
    """Working memory of one thread.

    Attributes:
        line: (3, width) f32, linear rgb of a row of samples.
        total: (3, width) f32, its sums over the samples of each pixel.
        frames: (I, 15) f64, see `surfaces.fill_frame`; entry i is valid if ``stamp[i] == stamp[-1]``.
        stamp: (I + 1,) i64, number of the image that ``frames`` was filled for; the last entry is the current image.
        runs: (MOST_NODES, 5) i64, the runs of a stretch of a row: first column, last column + 1, face, material, first
            node.
        nodes: f32, the nodes of these runs, see `lighting.NODE_ROW`.
    """

    line: np.ndarray
    total: np.ndarray
    frames: np.ndarray
    stamp: np.ndarray
    runs: np.ndarray
    nodes: np.ndarray


def make_shade_scratch(instances: int, width: int) -> ShadeScratch:
    """Allocate the scratch of one thread for I instances and rows of up to ``width`` samples."""
    return ShadeScratch(
        np.empty((3, width), np.float32),
        np.empty((3, width), np.float32),
        np.empty((instances, 15)),
        np.zeros(instances + 1, np.int64),
        np.empty((MOST_NODES, 5), np.int64),
        np.empty(NODE_ROWS * NODE_ROW, np.float32),
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
def _fill_plain(line, left, count, r, g, b, p, d):
    """Write ``count`` pixels of a run with the colour (r, g, b); light is ``p`` at ``left`` and changes by ``d``."""
    r0 = np.float32(r * p[0] + p[3])
    g0 = np.float32(g * p[1] + p[4])
    b0 = np.float32(b * p[2] + p[5])
    r1 = np.float32(r * d[0] + d[3])
    g1 = np.float32(g * d[1] + d[4])
    b1 = np.float32(b * d[2] + d[5])
    for k in range(np.uint64(count)):
        t = np.float32(np.int32(k))
        x = np.uint64(left) + k
        line[0, x] = r0 + t * r1
        line[1, x] = g0 + t * g1
        line[2, x] = b0 + t * b1


@color_inline
def _place_runs(
    surface,
    poses,
    home,
    looks,
    lens,
    openness,
    scratch,
    row,
    begin,
    end,
    inverse,
    ids,
    stride,
):
    """Find the runs of the pixels ``begin`` to ``end - 1`` of a row, and place the nodes of their light.

    Pixels of the background get their colour at once.

    Returns:
        The number of runs, written to ``scratch.runs``, and the number of nodes.
    """
    rows, columns = inverse.shape
    inv = 1.0 / lens.focal
    v = (0.5 * rows - row - 0.5) * inv
    light = scratch.nodes
    runs = 0
    nodes = 0
    x = begin
    while x < end:
        start = x
        seen = inverse[row, x] > 0.0
        tag = ids[row, x]
        x += 1
        while (
            x < end
            and (inverse[row, x] > 0.0) == seen
            and (ids[row, x] == tag or not seen)
        ):
            x += 1
        if not seen:
            for k in range(start, x):
                sky(
                    lens,
                    (k + 0.5 - 0.5 * columns) * inv,
                    v,
                    scratch.line,
                    k,
                )
            continue
        i = tag >> FACE_BITS
        face = surface.mesh_start[poses.drawn[i]] + (tag & ((1 << FACE_BITS) - 1))
        fill_frame(poses, scratch, lens, i)
        m = surface.instance_material[home, i]
        if m < 0:
            m = surface.face_material[face]
        m = looks[m]
        scratch.runs[runs, 0] = start
        scratch.runs[runs, 1] = x
        scratch.runs[runs, 2] = face
        scratch.runs[runs, 3] = m
        scratch.runs[runs, 4] = nodes
        runs += 1
        gloss = surface.gloss[m]
        smooth = surface.smooth[face]
        short = x - start <= SHORT_RUN
        at = (start + x) // 2 if short else start
        last = at if short else x - 1
        u = (at + 0.5 - 0.5 * columns) * inv
        nx, ny, nz = world_normal(
            surface, poses, scratch, i, face, u, v, 1.0 / inverse[row, at]
        )
        if not smooth:
            nx, ny, nz = towards_camera(lens, u, v, nx, ny, nz)
        while True:
            depth = np.float32(1.0) / inverse[row, at]
            u = (at + 0.5 - 0.5 * columns) * inv
            if smooth and at > start:
                nx, ny, nz = world_normal(surface, poses, scratch, i, face, u, v, depth)
            share = openness_at(openness, row, at, depth)
            write_node(light, nodes, u, depth, nx, ny, nz, gloss, share)
            nodes += 1
            if at == last:
                break
            at = min(at + stride, last)
    aim_nodes(lens, v, light, nodes)
    return runs, nodes


@color_inline
def _light_at(nodes, n):
    """Light of node ``n``: diffuse rgb, specular rgb."""
    return (
        float(nodes[n + DR]),
        float(nodes[n + DG]),
        float(nodes[n + DB]),
        float(nodes[n + SR]),
        float(nodes[n + SG]),
        float(nodes[n + SB]),
    )


@color_inline
def _shade_run(surface, lens, scratch, run, row, inverse, ids, stride):
    """Write the colours of a run into ``scratch.line``, from the light of its nodes."""
    height, width = inverse.shape
    inv = 1.0 / lens.focal
    cx = 0.5 * width - 0.5
    v = (0.5 * height - row - 0.5) * inv
    f = scratch.frames
    line = scratch.line
    start = scratch.runs[run, 0]
    stop = scratch.runs[run, 1]
    face = scratch.runs[run, 2]
    m = scratch.runs[run, 3]
    n = np.uint64(scratch.runs[run, 4])
    nodes = scratch.nodes
    i = ids[row, start] >> FACE_BITS
    plain = surface.texture[m] < 0
    r = surface.color[m, 0]
    g = surface.color[m, 1]
    b = surface.color[m, 2]
    short = stop - start <= SHORT_RUN
    if short and plain:
        red = np.float32(r * nodes[n + DR] + nodes[n + SR])
        green = np.float32(g * nodes[n + DG] + nodes[n + SG])
        blue = np.float32(b * nodes[n + DB] + nodes[n + SB])
        for x in range(start, stop):
            line[0, x] = red
            line[1, x] = green
            line[2, x] = blue
        return
    at = (start + stop) // 2 if short else start
    s0, su, sc, t0, tu, tc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if not plain:
        w = float(inverse[row, at])
        s0, su, sc, t0, tu, tc = texture_map(
            surface, f, i, face, m, (at - cx) * inv, v, w
        )
    left = start
    while left < stop:
        # The column of the next node.
        at = left + 1 if short else min(left + stride, stop - 1)
        end = stop if short or at == stop - 1 else at
        p = _light_at(nodes, n)
        q = p if short else _light_at(nodes, n + np.uint64(1))
        s = 1.0 / (at - left)
        d = (
            (q[0] - p[0]) * s,
            (q[1] - p[1]) * s,
            (q[2] - p[2]) * s,
            (q[3] - p[3]) * s,
            (q[4] - p[4]) * s,
            (q[5] - p[5]) * s,
        )
        if plain:
            _fill_plain(line, left, end - left, r, g, b, p, d)
        else:
            turned = max(float(nodes[n + FACING]), 0.05)
            pixel = inv / (float(inverse[row, left]) * np.sqrt(turned))
            level = texture_level(surface, m, face, f, i, pixel)
            for x in range(left, end):
                depth = 1.0 / inverse[row, x]
                u = (x - cx) * inv
                t = float(x - left)
                r, g, b = textured(
                    surface,
                    m,
                    level,
                    s0 + depth * (su * u + sc),
                    t0 + depth * (tu * u + tc),
                )
                line[0, x] = r * (p[0] + t * d[0]) + p[3] + t * d[3]
                line[1, x] = g * (p[1] + t * d[1]) + p[4] + t * d[4]
                line[2, x] = b * (p[2] + t * d[2]) + p[5] + t * d[5]
        left = end
        n += np.uint64(1)


@color_inline
def _store(line, total, s, part, tone, rgb, row):
    """Add row ``part`` (0..s - 1) of the samples of a row of pixels to the sums; after the last, write tone-mapped rgb.

    ``s`` is the number of samples per pixel side.
    """
    width = np.uint64(rgb.shape[1])
    scale = np.float32((tone.shape[0] - 1) / (TONE_RANGE * s * s))
    top = np.float32(tone.shape[0] - 1)
    for c in range(3):
        if s > 1:
            for k in range(width):
                level = total[c, k] if part > 0 else np.float32(0.0)
                for n in range(np.uint64(s)):
                    level += line[c, k * np.uint64(s) + n]
                total[c, k] = level
    if part == s - 1:
        light = total if s > 1 else line
        for k in range(width):
            for c in range(3):
                level = min(max(light[c, k] * scale, np.float32(0.0)), top)
                rgb[row, k, c] = tone[np.uint64(np.int32(level))]


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
    rows, columns = inverse.shape
    s = rows // rgb.shape[0]
    scratch.stamp[-1] += 1
    for row in range(rows):
        for begin in range(0, columns, MOST_NODES):
            # A stretch of a row has at most one node per pixel.
            end = min(begin + MOST_NODES, columns)
            runs, nodes = _place_runs(
                surface,
                poses,
                home,
                looks,
                lens,
                openness,
                scratch,
                row,
                begin,
                end,
                inverse,
                ids,
                stride,
            )
            light_nodes(lamps, home, scratch.nodes, nodes)
            for run in range(runs):
                _shade_run(surface, lens, scratch, run, row, inverse, ids, stride)
        _store(scratch.line, scratch.total, s, row % s, tone, rgb, row // s)
