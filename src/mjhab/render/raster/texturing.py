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
def pattern_axes(surface, i, face, f, u, v, w):
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
def textured(surface, f, i, face, m, first, second, level, u, v, w):
    """Colour, linear rgb, of a face with the textured material ``m``.

    ``first``, ``second``: the axes from `pattern_axes`; ``level``: the mip level.
    """
    x, y, z = place_point(f, i, u, v, 1.0 / w)
    color = surface.color
    texture = surface.texture[m]
    if surface.pattern[m]:
        # Every instance has another offset in the pattern.
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
    return copy_for(pixel * surface.face_density[face] * grow * np.sqrt(float(wide * high)))
