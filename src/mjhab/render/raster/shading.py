"""Compiled deferred shading: colour of every pixel from the ids and inverse depths of the z-buffer.

A row is shaded in runs of pixels on one face. Light changes slowly along a run: it is computed every few pixels (at
nodes) and blended; colours of textures are looked up at every pixel. Light is linear rgb until ``tone_curve``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.render.patterns import SHADE_TOP
from mjhab.render.raster.arrays import FACE_BITS
from mjhab.render.raster.jit import color_inline, color_kernel
from mjhab.render.raster.lighting import blended_share, light_point, sky
from mjhab.render.textures import Texels, copy_for, sample

SHORT_RUN = 3
"""Runs up to this many samples are lit alike."""
TONE_RANGE = 4.0
"""Linear value that the last entry of ``tone_curve`` stands for."""


class Surface(NamedTuple):
    """Looks of faces and materials (arrays of RenderScene); instance_material (H, I) or -1.

    mesh_start (N,) i32: first face; smooth (F,) bool: the normal varies over the face; extent (I, 3): size of each
    instance's mesh along its axes [m].
    """

    mesh_start: np.ndarray
    face_material: np.ndarray
    face_normal: np.ndarray
    face_uv: np.ndarray
    face_density: np.ndarray
    smooth: np.ndarray
    instance_material: np.ndarray
    extent: np.ndarray
    color: np.ndarray
    color2: np.ndarray
    texture: np.ndarray
    pattern: np.ndarray
    size: np.ndarray
    gloss: np.ndarray
    texels: Texels


class Openness(NamedTuple):
    """share, depths (a, b) f32 as ``occlusion`` fills them, or (0, 0); cells: cells per pixel."""

    share: np.ndarray
    depths: np.ndarray
    cells: float


class ShadeScratch(NamedTuple):
    """line, total (3, width) f32: linear light of a row of samples, and its sums; frames (I, 15) f64 of the instances
    in the current image, valid where stamp (I,) i64 equals stamp[-1] (one entry more)."""

    line: np.ndarray
    total: np.ndarray
    frames: np.ndarray
    stamp: np.ndarray


def make_shade_scratch(instances: int, width: int) -> ShadeScratch:
    """Scratch for one thread and rows up to ``width`` samples."""
    return ShadeScratch(
        np.empty((3, width), np.float32),
        np.empty((3, width), np.float32),
        np.empty((instances, 15)),
        np.zeros(instances + 1, np.int64),
    )


def tone_curve(entries: int = 16384) -> np.ndarray:
    """Table (entries,) uint8 over linear light 0..`TONE_RANGE`: sRGB with a soft shoulder above 0.6."""
    linear = np.linspace(0.0, TONE_RANGE, entries)
    over = np.maximum(linear - 0.6, 0.0)
    linear = np.minimum(linear, 0.6) + 0.4 * (1.0 - np.exp(-over / 0.4))
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255.0 * np.clip(srgb, 0.0, 1.0)).astype(np.uint8)


@color_inline
def _frame(poses, room, lens, i):
    """Fill frames[i]: the camera (0:3) and its axes (3:12, by rows) in the instance's axes, 1 / scale (12:15)."""
    if room.stamp[i] == room.stamp[-1]:
        return
    room.stamp[i] = room.stamp[-1]
    f = room.frames
    rot = poses.rot
    m = lens.mat
    d0 = lens.pos[0] - poses.pos[i, 0]
    d1 = lens.pos[1] - poses.pos[i, 1]
    d2 = lens.pos[2] - poses.pos[i, 2]
    for r in range(3):
        a = rot[i, 0, r]
        b = rot[i, 1, r]
        c = rot[i, 2, r]
        f[i, r] = a * d0 + b * d1 + c * d2
        for k in range(3):
            f[i, 3 + 3 * r + k] = a * m[0, k] + b * m[1, k] + c * m[2, k]
        f[i, 12 + r] = 1.0 / poses.scale[i, r]


@color_inline
def _place(f, i, u, v, depth):
    """Point in the instance's axes [m] at a depth along the ray with slopes (u, v)."""
    x = f[i, 0] + depth * (f[i, 3] * u + f[i, 4] * v - f[i, 5])
    y = f[i, 1] + depth * (f[i, 6] * u + f[i, 7] * v - f[i, 8])
    z = f[i, 2] + depth * (f[i, 9] * u + f[i, 10] * v - f[i, 11])
    return x, y, z


@color_inline
def _normal(surface, f, i, face, x, y, z):
    """Unit normal of a face at a point, both in the instance's axes."""
    n = surface.face_normal
    sx = f[i, 12]
    sy = f[i, 13]
    sz = f[i, 14]
    nx = float(n[face, 0, 3])
    ny = float(n[face, 1, 3])
    nz = float(n[face, 2, 3])
    if surface.smooth[face]:
        x = x * sx
        y = y * sy
        z = z * sz
        nx += n[face, 0, 0] * x + n[face, 0, 1] * y + n[face, 0, 2] * z
        ny += n[face, 1, 0] * x + n[face, 1, 1] * y + n[face, 1, 2] * z
        nz += n[face, 2, 0] * x + n[face, 2, 1] * y + n[face, 2, 2] * z
    nx = nx * sx
    ny = ny * sy
    nz = nz * sz
    length = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz + 1e-30)
    return nx * length, ny * length, nz * length


@color_inline
def _node(surface, poses, lamps, home, lens, openness, room, i, face, gloss, u, v, w, col, row):
    """Light (6 numbers) at a pixel of inverse depth ``w``, and how much the face is turned to the camera."""
    depth = 1.0 / w
    m = lens.mat
    rot = poses.rot
    rx = m[0, 0] * u + m[0, 1] * v - m[0, 2]
    ry = m[1, 0] * u + m[1, 1] * v - m[1, 2]
    rz = m[2, 0] * u + m[2, 1] * v - m[2, 2]
    px, py, pz = _place(room.frames, i, u, v, depth)
    px, py, pz = _normal(surface, room.frames, i, face, px, py, pz)
    nx = rot[i, 0, 0] * px + rot[i, 0, 1] * py + rot[i, 0, 2] * pz
    ny = rot[i, 1, 0] * px + rot[i, 1, 1] * py + rot[i, 1, 2] * pz
    nz = rot[i, 2, 0] * px + rot[i, 2, 1] * py + rot[i, 2, 2] * pz
    inv = -1.0 / np.sqrt(rx * rx + ry * ry + rz * rz)
    vx = rx * inv
    vy = ry * inv
    vz = rz * inv
    facing = nx * vx + ny * vy + nz * vz
    if facing < 0.0 and not surface.smooth[face]:
        nx = -nx
        ny = -ny
        nz = -nz
        facing = -facing
    open_share = 1.0
    if openness.share.shape[0] > 0:
        rows = (row + 0.5) * openness.cells
        cols = (col + 0.5) * openness.cells
        open_share = blended_share(openness.share, openness.depths, rows, cols, depth)
    x = lens.pos[0] + rx * depth
    y = lens.pos[1] + ry * depth
    z = lens.pos[2] + rz * depth
    return light_point(lamps, home, x, y, z, nx, ny, nz, vx, vy, vz, gloss, open_share), max(
        facing, 0.05
    )


@color_inline
def _axes(surface, i, face, f, u, v, w):
    """Axes (u, v) of the plane that a patterned face lies in; u runs along the longer side of the piece."""
    e = surface.extent
    x, y, z = _place(f, i, u, v, 1.0 / w)
    x, y, z = _normal(surface, f, i, face, x, y, z)
    x = abs(x)
    y = abs(y)
    z = abs(z)
    sx = e[i, 0] / abs(f[i, 12])
    sy = e[i, 1] / abs(f[i, 13])
    sz = e[i, 2] / abs(f[i, 14])
    if z >= x and z >= y:
        return (0, 1) if sx >= sy else (1, 0)
    if x >= y:
        return (1, 2) if sy >= sz else (2, 1)
    return (0, 2) if sx >= sz else (2, 0)


@color_inline
def _pick(axis, x, y, z):
    return x if axis == 0 else (y if axis == 1 else z)


@color_inline
def _linear(level):
    """Linear light of an sRGB value 0..255 (cubic, within 0.002)."""
    c = level * (1.0 / 255.0)
    return c * (c * (c * 0.305306011 + 0.682171111) + 0.012522878)


@color_inline
def _textured(surface, f, i, face, m, first, second, level, u, v, w):
    """Colour, linear rgb, of a face with a texture at a pixel of inverse depth ``w``."""
    x, y, z = _place(f, i, u, v, 1.0 / w)
    color = surface.color
    texture = surface.texture[m]
    if surface.pattern[m]:
        # Every piece starts elsewhere in the pattern.
        s = _pick(first, x, y, z) / surface.size[m, 0] + 0.37 * i
        t = _pick(second, x, y, z) / surface.size[m, 1] + 0.23 * i
        mix, shade, _ = sample(surface.texels, texture, level, s, t)
        mix = mix * (1.0 / 255.0)
        shade = shade * (SHADE_TOP / 255.0)
        other = surface.color2
        return (
            shade * (color[m, 0] + mix * (other[m, 0] - color[m, 0])),
            shade * (color[m, 1] + mix * (other[m, 1] - color[m, 1])),
            shade * (color[m, 2] + mix * (other[m, 2] - color[m, 2])),
        )
    x = x * f[i, 12]
    y = y * f[i, 13]
    z = z * f[i, 14]
    a = surface.face_uv
    s = a[face, 0, 0] * x + a[face, 0, 1] * y + a[face, 0, 2] * z + a[face, 0, 3]
    t = a[face, 1, 0] * x + a[face, 1, 1] * y + a[face, 1, 2] * z + a[face, 1, 3]
    r, g, b = sample(surface.texels, texture, level, s, t)
    return color[m, 0] * _linear(r), color[m, 1] * _linear(g), color[m, 2] * _linear(b)


@color_inline
def _copy(surface, m, face, f, i, pixel):
    """Level of a material's texture for pixels of this size on the surface [m]."""
    texture = surface.texture[m]
    if texture < 0:
        return 0
    wide = 1 << surface.texels.bits[texture, 0]
    high = 1 << surface.texels.bits[texture, 1]
    if surface.pattern[m]:
        return copy_for(pixel * max(wide / surface.size[m, 0], high / surface.size[m, 1]))
    grow = max(abs(f[i, 12]), abs(f[i, 13]), abs(f[i, 14]))
    return copy_for(pixel * surface.face_density[face] * grow * np.sqrt(float(wide * high)))


@color_inline
def _fill_plain(line, left, count, r, g, b, p, d):
    """Pixels of one colour in light that changes by ``d`` per pixel from ``p``."""
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


# One long function with many parameters: what it computes stays in registers, and the order of its sums, which
# ``fastmath`` may change with the shape of the code, decides the last bit of a colour.
@color_inline
def _shade_run(
    surface, poses, lamps, home, lens, openness, room, i, face, row, start, stop, inverse, stride
):
    """Shade the pixels ``start`` to ``stop`` of a row, all on one face, into the line."""
    height, width = inverse.shape
    inv = 1.0 / lens.focal
    cx = 0.5 * width - 0.5
    v = (0.5 * height - row - 0.5) / lens.focal
    f = room.frames
    line = room.line
    _frame(poses, room, lens, i)
    m = surface.instance_material[home, i]
    if m < 0:
        m = surface.face_material[face]
    plain = surface.texture[m] < 0
    gloss = surface.gloss[m]
    r = surface.color[m, 0]
    g = surface.color[m, 1]
    b = surface.color[m, 2]
    short = stop - start <= SHORT_RUN
    at = (start + stop) // 2 if short else start
    left = start
    begun = False
    u = (at - cx) * inv
    w = float(inverse[row, at])
    first, second = _axes(surface, i, face, f, u, v, w) if surface.pattern[m] else (0, 1)
    p = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    turned = 1.0
    while left < stop:
        u = (at - cx) * inv
        w = float(inverse[row, at])
        q, facing = _node(
            surface, poses, lamps, home, lens, openness, room, i, face, gloss, u, v, w, at, row
        )
        if begun or short:
            s = 1.0 / (at - left) if begun else 0.0
            end = stop if short or at == stop - 1 else at
            if not begun:
                p = q
                turned = facing
            d = (
                (q[0] - p[0]) * s,
                (q[1] - p[1]) * s,
                (q[2] - p[2]) * s,
                (q[3] - p[3]) * s,
                (q[4] - p[4]) * s,
                (q[5] - p[5]) * s,
            )
            level = _copy(
                surface, m, face, f, i, inv / (float(inverse[row, left]) * np.sqrt(turned))
            )
            if plain:
                _fill_plain(line, left, end - left, r, g, b, p, d)
            else:
                for x in range(left, end):
                    w = float(inverse[row, x])
                    t = float(x - left)
                    r, g, b = _textured(
                        surface, f, i, face, m, first, second, level, (x - cx) * inv, v, w
                    )
                    line[0, x] = r * (p[0] + t * d[0]) + p[3] + t * d[3]
                    line[1, x] = g * (p[1] + t * d[1]) + p[4] + t * d[4]
                    line[2, x] = b * (p[2] + t * d[2]) + p[5] + t * d[5]
            left = end
        p = q
        turned = facing
        begun = True
        at = min(at + stride, stop - 1)


@color_inline
def _store(line, total, s, part, tone, rgb, row):
    """Add a line of samples, ``part`` of ``s`` of a row of pixels, to its sums; with the last one write the pixels."""
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
def shade(surface, poses, lamps, home, lens, inverse, ids, openness, tone, room, stride, rgb):
    """Shade an image into ``rgb`` (h, w, 3) uint8 from buffers (s h, s w), averaging s x s samples in linear light.

    ``poses``: the scratch ``place_instances`` and ``draw`` filled; ``stride``: samples between nodes of light.
    """
    rows, columns = inverse.shape
    s = rows // rgb.shape[0]
    inv = 1.0 / lens.focal
    room.stamp[-1] += 1
    for row in range(rows):
        x = 0
        while x < columns:
            start = x
            seen = inverse[row, x] > 0.0
            tag = ids[row, x]
            x += 1
            while (
                x < columns and (inverse[row, x] > 0.0) == seen and (ids[row, x] == tag or not seen)
            ):
                x += 1
            if seen:
                i = tag >> FACE_BITS
                face = surface.mesh_start[poses.drawn[i]] + (tag & ((1 << FACE_BITS) - 1))
                _shade_run(
                    surface,
                    poses,
                    lamps,
                    home,
                    lens,
                    openness,
                    room,
                    i,
                    face,
                    row,
                    start,
                    x,
                    inverse,
                    stride,
                )
                continue
            for k in range(start, x):
                sky(
                    lens,
                    (k + 0.5 - 0.5 * columns) * inv,
                    (0.5 * rows - row - 0.5) * inv,
                    room.line,
                    k,
                )
        _store(room.line, room.total, s, row % s, tone, rgb, row // s)
