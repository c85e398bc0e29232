"""Kernels of textured colours: patterns mapped by planar projection along an instance's axes, and images by uv.

``f`` are the frames of `surfaces.fill_frame`; (u, v) are the slopes of the pixel's ray; ``w`` its inverse depth [1/m].
"""

from __future__ import annotations

import numpy as np

from mjhab.render.jit import color_inline
from mjhab.render.patterns import SHADE_TOP
from mjhab.render.raster.surfaces import normal_at, place_point
from mjhab.render.textures import copy_for, sample


@color_inline
def _pattern_axes(surface, i, face, f, u, v, w):
    """Axes (0..2) of the instance that u and v of a pattern run along, for a face of instance ``i``.

    They span the coordinate plane most parallel to the face; u runs along the longer side of the instance.
    """
    e = surface.extent
    x, y, z = place_point(f, i, u, v, 1.0 / w)
    x, y, z = normal_at(surface, f, i, face, x, y, z)
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
    """Linear light 0..1 of an sRGB value 0..255 (cubic approximation, error below 0.002)."""
    c = level * (1.0 / 255.0)
    return c * (c * (c * 0.305306011 + 0.682171111) + 0.012522878)


@color_inline
def texture_map(surface, f, i, face, m, u, v, w):
    """Map from the pixels of a run to the coordinates (s, t) of the texture of material ``m``.

    ``u``, ``w``: of one pixel of the run. A pixel with the slope u at a depth d has ``s = s0 + d * (su * u + sc)``,
    and t likewise.

    Returns:
        s0, su, sc, t0, tu, tc.
    """
    # The point of a pixel, in the frame of the instance, is o + d * (a * u + c) along each axis.
    ox = f[i, 0]
    oy = f[i, 1]
    oz = f[i, 2]
    ax = f[i, 3]
    ay = f[i, 6]
    az = f[i, 9]
    cx = f[i, 4] * v - f[i, 5]
    cy = f[i, 7] * v - f[i, 8]
    cz = f[i, 10] * v - f[i, 11]
    if surface.pattern[m]:
        first, second = _pattern_axes(surface, i, face, f, u, v, w)
        wide = 1.0 / surface.size[m, 0]
        high = 1.0 / surface.size[m, 1]
        # Every instance has another offset in the pattern.
        return (
            _pick(first, ox, oy, oz) * wide + 0.37 * i,
            _pick(first, ax, ay, az) * wide,
            _pick(first, cx, cy, cz) * wide,
            _pick(second, ox, oy, oz) * high + 0.23 * i,
            _pick(second, ax, ay, az) * high,
            _pick(second, cx, cy, cz) * high,
        )
    e = surface.face_uv
    sx = e[face, 0, 0] * f[i, 12]
    sy = e[face, 0, 1] * f[i, 13]
    sz = e[face, 0, 2] * f[i, 14]
    tx = e[face, 1, 0] * f[i, 12]
    ty = e[face, 1, 1] * f[i, 13]
    tz = e[face, 1, 2] * f[i, 14]
    return (
        sx * ox + sy * oy + sz * oz + e[face, 0, 3],
        sx * ax + sy * ay + sz * az,
        sx * cx + sy * cy + sz * cz,
        tx * ox + ty * oy + tz * oz + e[face, 1, 3],
        tx * ax + ty * ay + tz * az,
        tx * cx + ty * cy + tz * cz,
    )


@color_inline
def textured(surface, m, level, s, t):
    """Colour, linear rgb, of the textured material ``m`` at (s, t); ``level``: the mip level."""
    color = surface.color
    texture = surface.texture[m]
    if surface.pattern[m]:
        mix, shade, _ = sample(surface.texels, texture, level, s, t)
        mix = mix * (1.0 / 255.0)
        shade = shade * (SHADE_TOP / 255.0)
        other = surface.color2
        return (
            shade * (color[m, 0] + mix * (other[m, 0] - color[m, 0])),
            shade * (color[m, 1] + mix * (other[m, 1] - color[m, 1])),
            shade * (color[m, 2] + mix * (other[m, 2] - color[m, 2])),
        )
    r, g, b = sample(surface.texels, texture, level, s, t)
    return color[m, 0] * _linear(r), color[m, 1] * _linear(g), color[m, 2] * _linear(b)


@color_inline
def texture_level(surface, m, face, f, i, pixel):
    """Mip level of a material's texture for pixels that cover a length ``pixel`` [m] on the surface."""
    texture = surface.texture[m]
    if texture < 0:
        return 0
    wide = 1 << surface.texels.bits[texture, 0]
    high = 1 << surface.texels.bits[texture, 1]
    if surface.pattern[m]:
        return copy_for(pixel * max(wide / surface.size[m, 0], high / surface.size[m, 1]))
    grow = max(abs(f[i, 12]), abs(f[i, 13]), abs(f[i, 14]))
    return copy_for(
        pixel * surface.face_density[face] * grow * np.sqrt(float(wide * high))
    )
