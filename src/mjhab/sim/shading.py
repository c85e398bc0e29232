"""Compiled deferred shading: colour of every pixel from the ids and inverse depths of the z-buffer.

Light is linear rgb until ``tone_curve``. There are no textures: see ``patterns``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from mjhab.sim.patterns import INLINE, JIT, pattern

TONE_RANGE = 4.0
"""Linear value that the last entry of ``tone_curve`` stands for."""
LAMP_REACH = 2.4
"""Distance [m] at which a lamp of intensity 1 has lost half its light."""
SHADOW_SLOPE = 0.2
"""Lamps look straight down in shadow maps; 0.2 is the cosine below which (78.5 deg) a direction has no map."""
SKY = (0.36, 0.38, 0.42)
GROUND = (0.25, 0.215, 0.185)
HEAD_LIGHT = 0.10
LAMP_GAIN = 0.85
"""Exposure of lamps: a white floor 2.4 m below a lamp of intensity 1 comes out light, not burnt out."""
UNMAPPED = 0.65
"""Share of a lamp's light that goes where its shadow map does not reach (upper walls)."""


class Surface(NamedTuple):
    """Looks of faces and materials (arrays of RenderScene) plus each instance's material (I,) or -1.

    smooth (F,) bool: the corners of the face have different normals; extent (I, 3): size of each instance [m].
    """

    vertices: np.ndarray
    faces: np.ndarray
    corner_normals: np.ndarray
    smooth: np.ndarray
    face_material: np.ndarray
    instance_material: np.ndarray
    extent: np.ndarray
    color: np.ndarray
    color2: np.ndarray
    kind: np.ndarray
    scale: np.ndarray
    gloss: np.ndarray


class Lamps(NamedTuple):
    """pos, color (L, 3); shadow (L, S, S) f32 inverse depths seen straight down, or (0, 1, 1) without shadows."""

    pos: np.ndarray
    color: np.ndarray
    shadow: np.ndarray


def tone_curve(entries: int = 4096) -> np.ndarray:
    """Table (entries,) uint8: index ``sqrt(linear / TONE_RANGE)`` to sRGB with a soft shoulder above 0.6."""
    linear = np.linspace(0.0, 1.0, entries) ** 2 * TONE_RANGE
    over = np.maximum(linear - 0.6, 0.0)
    linear = np.minimum(linear, 0.6) + 0.4 * (1.0 - np.exp(-over / 0.4))
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255.0 * np.clip(srgb, 0.0, 1.0)).astype(np.uint8)


@njit(**INLINE)
def _normal(surface, pose, i, face, x, y, z):
    """World normal of a face at local point (x, y, z) (metres, unscaled axes); interpolated on smooth faces."""
    sx, sy, sz = pose.scale[i, 0], pose.scale[i, 1], pose.scale[i, 2]
    n = surface.corner_normals
    nx, ny, nz = float(n[face, 0, 0]), float(n[face, 0, 1]), float(n[face, 0, 2])
    if surface.smooth[face]:
        p = surface.vertices
        a, b, c = surface.faces[face, 0], surface.faces[face, 1], surface.faces[face, 2]
        e1x, e1y, e1z = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
        e2x, e2y, e2z = p[c, 0] - p[a, 0], p[c, 1] - p[a, 1], p[c, 2] - p[a, 2]
        px, py, pz = x / sx - p[a, 0], y / sy - p[a, 1], z / sz - p[a, 2]
        d11 = e1x * e1x + e1y * e1y + e1z * e1z
        d12 = e1x * e2x + e1y * e2y + e1z * e2z
        d22 = e2x * e2x + e2y * e2y + e2z * e2z
        d1, d2 = px * e1x + py * e1y + pz * e1z, px * e2x + py * e2y + pz * e2z
        det = d11 * d22 - d12 * d12 + 1e-30
        v, w = (d22 * d1 - d12 * d2) / det, (d11 * d2 - d12 * d1) / det
        v, w = min(max(v, 0.0), 1.0), min(max(w, 0.0), 1.0)
        u = max(1.0 - v - w, 0.0)
        nx = u * n[face, 0, 0] + v * n[face, 1, 0] + w * n[face, 2, 0]
        ny = u * n[face, 0, 1] + v * n[face, 1, 1] + w * n[face, 2, 1]
        nz = u * n[face, 0, 2] + v * n[face, 1, 2] + w * n[face, 2, 2]
    nx, ny, nz = nx / sx, ny / sy, nz / sz
    length = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz + 1e-30)
    return nx * length, ny * length, nz * length


@njit(**INLINE)
def _visible(shadow, k, x, y, z, nx, ny, nz):
    """Share 0..1 of light that reaches the point (x, y, z) from lamp ``k`` at the origin: 4 x 4 taps, blended.

    (nx, ny, nz) is the surface normal there: every tap is compared with the plane of the surface.
    """
    depth = -z
    size = shadow.shape[1]
    far = SHADOW_SLOPE * np.sqrt(x * x + y * y + z * z)
    if depth <= 0.02 or depth <= far:
        return UNMAPPED
    inv_focal = np.sqrt(1.0 - SHADOW_SLOPE * SHADOW_SLOPE) / (0.5 * size * SHADOW_SLOPE)
    w = 1.0 / depth
    u, v = 0.5 * size + x * w / inv_focal - 0.5, 0.5 * size - y * w / inv_focal - 0.5
    if u < 1.0 or v < 1.0 or u > size - 3.0 or v > size - 3.0:
        return UNMAPPED
    i, j = int(v), int(u)
    fy, fx = v - i, u - j
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


@njit(**INLINE)
def _lamp_light(lamps, x, y, z, nx, ny, nz, vx, vy, vz, gloss, out):
    """Add diffuse light of all lamps at a point to ``out[0:3]`` and highlights to ``out[3:6]``."""
    for k in range(lamps.pos.shape[0]):
        r, g, b = lamps.color[k, 0], lamps.color[k, 1], lamps.color[k, 2]
        lx, ly, lz = lamps.pos[k, 0] - x, lamps.pos[k, 1] - y, lamps.pos[k, 2] - z
        square = lx * lx + ly * ly + lz * lz
        facing = nx * lx + ny * ly + nz * lz
        if facing <= 0.0:
            continue
        inv = 1.0 / np.sqrt(square + 1e-9)
        power = LAMP_GAIN * facing * inv / (0.35 + (0.65 / (LAMP_REACH * LAMP_REACH)) * square)
        if power * (r + g + b) < 0.01:
            continue
        if lamps.shadow.shape[0] > 0:
            power *= _visible(lamps.shadow, k, 0.01 * nx - lx, 0.01 * ny - ly, 0.01 * nz - lz, nx, ny, nz)
        out[0] += r * power
        out[1] += g * power
        out[2] += b * power
        hx, hy, hz = lx * inv + vx, ly * inv + vy, lz * inv + vz
        h = (nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz + 1e-9)
        h2 = h * h
        h4 = h2 * h2
        h16 = h4 * h4 * h4 * h4
        shine = gloss * power * ((1.0 - gloss) * h16 + gloss * 2.0 * h16 * h16 * h16 * h16)
        out[3] += r * shine
        out[4] += g * shine
        out[5] += b * shine


@njit(**INLINE)
def _sky(dz, out):
    """Background seen along a direction with vertical part ``dz``."""
    t = min(max(0.5 + 0.9 * dz, 0.0), 1.0)
    out[0], out[1], out[2] = 0.30 + 0.28 * t, 0.34 + 0.32 * t, 0.40 + 0.38 * t


@njit(**INLINE)
def _material(surface, i, face, x, y, z, nx, ny, nz, footprint):
    """Material of a face, and the mix of its two colours and the shade at a local point; footprint: pixel [m]."""
    m = surface.instance_material[i]
    if m < 0:
        m = surface.face_material[face]
    mix, shade = 0.0, 1.0
    if surface.kind[m] != 0:
        mix, shade = pattern(
            surface.kind[m], surface.scale[m], x, y, z, nx, ny, nz,
            surface.extent[i, 0], surface.extent[i, 1], surface.extent[i, 2], footprint,
        )  # fmt: skip
    return m, mix, shade


@njit(**INLINE)
def _shade_point(surface, pose, lamps, lens, tag, depth, rx, ry, rz, open_share, pixel, light, out):
    """Linear colour into ``out[0:3]`` of the point at planar ``depth`` along the ray (rx, ry, rz)."""
    i, face = tag >> 32, tag & 0xFFFFFFFF
    x, y, z = lens.pos[0] + rx * depth, lens.pos[1] + ry * depth, lens.pos[2] + rz * depth
    dx, dy, dz = x - pose.pos[i, 0], y - pose.pos[i, 1], z - pose.pos[i, 2]
    rot = pose.rot
    qx = rot[i, 0, 0] * dx + rot[i, 1, 0] * dy + rot[i, 2, 0] * dz
    qy = rot[i, 0, 1] * dx + rot[i, 1, 1] * dy + rot[i, 2, 1] * dz
    qz = rot[i, 0, 2] * dx + rot[i, 1, 2] * dy + rot[i, 2, 2] * dz
    ox, oy, oz = _normal(surface, pose, i, face, qx, qy, qz)
    nx = rot[i, 0, 0] * ox + rot[i, 0, 1] * oy + rot[i, 0, 2] * oz
    ny = rot[i, 1, 0] * ox + rot[i, 1, 1] * oy + rot[i, 1, 2] * oz
    nz = rot[i, 2, 0] * ox + rot[i, 2, 1] * oy + rot[i, 2, 2] * oz
    inv = -1.0 / np.sqrt(rx * rx + ry * ry + rz * rz)
    vx, vy, vz = rx * inv, ry * inv, rz * inv
    facing = nx * vx + ny * vy + nz * vz
    if facing < 0.0 and not surface.smooth[face]:
        nx, ny, nz, facing = -nx, -ny, -nz, -facing
    facing = max(facing, 0.0)
    m, mix, shade = _material(surface, i, face, qx, qy, qz, ox, oy, oz, pixel * depth / np.sqrt(max(facing, 0.05)))
    for k in range(6):
        light[k] = 0.0
    gloss = surface.gloss[m]
    _lamp_light(lamps, x, y, z, nx, ny, nz, vx, vy, vz, gloss, light)
    up = 0.5 + 0.5 * nz
    side = open_share * (1.0 + 0.10 * nx + 0.05 * ny)
    away = 1.0 - facing
    rim = gloss * 0.25 * away * away * away * away * open_share
    for c in range(3):
        albedo = shade * (surface.color[m, c] + mix * (surface.color2[m, c] - surface.color[m, c]))
        ambient = (GROUND[c] + (SKY[c] - GROUND[c]) * up) * side
        direct = light[c] * (0.35 + 0.65 * open_share) + HEAD_LIGHT * facing
        out[c] = albedo * (ambient + direct) + light[3 + c] * open_share + rim * SKY[c]


@njit(**INLINE)
def _open_share(share, depths, row, col, depth):
    """Ambient openness at a pixel (row, col in cells of ``share``): blend of four cells at like depth."""
    height, width = share.shape
    fy, fx = max(row - 0.5, 0.0), max(col - 0.5, 0.0)
    i, j = min(int(fy), height - 1), min(int(fx), width - 1)
    fy, fx = fy - i, fx - j
    total, weight = 0.0, 1e-9
    for r in range(2):
        for c in range(2):
            y, x = min(i + r, height - 1), min(j + c, width - 1)
            w = (fy if r else 1.0 - fy) * (fx if c else 1.0 - fx) + 1e-3
            w *= 1e-4 + max(0.0, 1.0 - 20.0 * abs(depths[y, x] * depth - 1.0))
            total += w * share[y, x]
            weight += w
    return total / weight


@njit(**INLINE)
def _shade_sample(surface, pose, lamps, lens, tag, w, u, v, row, col, share, share_depth, pixel, light, out):
    """Linear colour into ``out`` of what a sample sees: the sky, or a face at inverse depth ``w``.

    (u, v): slope of its ray to the right and up; (row, col): its pixel in cells of ``share``; pixel: size of a
    pixel at depth 1.
    """
    m = lens.mat
    rx = m[0, 0] * u + m[0, 1] * v - m[0, 2]
    ry = m[1, 0] * u + m[1, 1] * v - m[1, 2]
    rz = m[2, 0] * u + m[2, 1] * v - m[2, 2]
    if tag < 0:
        _sky(rz / np.sqrt(rx * rx + ry * ry + rz * rz), out)
        return
    depth, open_share = 1.0 / w, 1.0
    if share.shape[0] > 0:
        open_share = _open_share(share, share_depth, row, col, depth)
    _shade_point(surface, pose, lamps, lens, tag, depth, rx, ry, rz, open_share, pixel, light, out)


@njit(**JIT)
def shade(surface, pose, lamps, lens, inverse, ids, share, share_depth, tone, scratch, rgb):
    """Shade an image into ``rgb`` (h, w, 3) uint8 from buffers (s h, s w), averaging s x s samples in linear light.

    A face is shaded once per pixel however many of its samples it covers. ``share`` (a, b): ambient openness
    with the inverse depths ``share_depth`` it was taken at, or (0, 0). ``scratch`` (3, 6) f64.
    """
    height, width = rgb.shape[0], rgb.shape[1]
    s = inverse.shape[0] // height
    cx, cy, inv = 0.5 * width * s, 0.5 * height * s, 1.0 / lens.focal
    out, light, total = scratch[0], scratch[1], scratch[2]
    top = (tone.shape[0] - 1) / np.sqrt(TONE_RANGE)
    mean = 1.0 / (s * s)
    rows, cols = share.shape[0] / height, share.shape[1] / width
    for i in range(height):
        for j in range(width):
            total[0] = total[1] = total[2] = 0.0
            last = np.int64(-2)
            for r in range(s):
                y = i * s + r
                for c in range(s):
                    x = j * s + (c if r & 1 == 0 else s - 1 - c)
                    w = inverse[y, x]
                    tag = ids[y, x] if w > 0.0 else np.int64(-1)
                    if tag != last:
                        last = tag
                        u, v = (x + 0.5 - cx) * inv, (cy - y - 0.5) * inv
                        row, col = (i + 0.5) * rows, (j + 0.5) * cols
                        _shade_sample(
                            surface, pose, lamps, lens, tag, w, u, v, row, col, share, share_depth, inv * s, light, out
                        )
                    for k in range(3):
                        total[k] += out[k]
            for k in range(3):
                level = min(max(total[k] * mean, 0.0), TONE_RANGE)
                rgb[i, j, k] = tone[int(np.sqrt(level) * top)]
