# type: ignore
# ruff: noqa: RUF046, UP018
# Kernels are written in Warp's language, which has Python's syntax but its own types. A variable that changes must be
# made by float() or int(); otherwise Warp treats it as a constant.
"""Textured colours on a device: patterns and images, as in ``raster.texturing`` and ``textures`` on the CPU."""

from __future__ import annotations

import warp as wp

from mjhab.render.patterns import SHADE_TOP
from mjhab.render.textures import LEVELS
from mjhab.render.warp.looks import SceneArrays

SHADE_STEP = wp.constant(SHADE_TOP / 255.0)
LAST_LEVEL = wp.constant(LEVELS - 1)


@wp.func
def _texel(looks: SceneArrays, at: int):
    """Red, green and blue (0..255) of a texel."""
    packed = looks.pixels[at]
    low = wp.uint32(255)
    return wp.vec3(
        float(packed & low),
        float((packed >> wp.uint32(8)) & low),
        float((packed >> wp.uint32(16)) & low),
    )


@wp.func
def _sample(looks: SceneArrays, texture: int, level: int, u: float, v: float):
    """Red, green and blue (0..255) at (u, v) of a mip level, interpolated bilinearly; the texture repeats."""
    wide = wp.max(looks.bits[texture, 0] - level, 0)
    high = wp.max(looks.bits[texture, 1] - level, 0)
    start = looks.start[texture, level]
    columns = 1 << wide
    rows = 1 << high
    x = (u - wp.floor(u)) * float(columns) - 0.5
    y = (v - wp.floor(v)) * float(rows) - 0.5
    i = int(wp.floor(x))
    j = int(wp.floor(y))
    a = x - wp.floor(x)
    b = y - wp.floor(y)
    i0 = i & (columns - 1)
    i1 = (i + 1) & (columns - 1)
    j0 = start + ((j & (rows - 1)) << wide)
    j1 = start + (((j + 1) & (rows - 1)) << wide)
    above = _texel(looks, j0 + i0) * (1.0 - a) + _texel(looks, j0 + i1) * a
    below = _texel(looks, j1 + i0) * (1.0 - a) + _texel(looks, j1 + i1) * a
    return above * (1.0 - b) + below * b


@wp.func
def _copy_for(texels_per_pixel: float):
    """Mip level whose texels are about as large as a pixel, for this number of level-0 texels per pixel side."""
    size = float(texels_per_pixel)
    level = int(0)
    while size > 1.42 and level < LAST_LEVEL:
        size = size * 0.5
        level += 1
    return level


@wp.func
def _linear(level: wp.vec3):
    """Convert sRGB values 0..255 to linear light (cubic approximation, error below 0.002)."""
    c = level * (1.0 / 255.0)
    c2 = wp.cw_mul(c, c)
    return c * 0.012522878 + c2 * 0.682171111 + wp.cw_mul(c2, c) * 0.305306011


@wp.func
def pattern_color(
    looks: SceneArrays,
    m: int,
    i: int,
    q: wp.vec3,
    n: wp.vec3,
    scale: wp.vec3,
    pixel: float,
):
    """Linear rgb of the patterned material ``m`` at the point ``q`` [m] with normal ``n`` (frame of instance ``i``).

    The pattern is projected onto the coordinate plane most parallel to the face, u along the longer side of the
    instance. ``scale`` is the instance's scale; ``pixel`` the length that a pixel covers on the surface [m].
    """
    a = wp.vec3(wp.abs(n[0]), wp.abs(n[1]), wp.abs(n[2]))
    e = wp.cw_mul(looks.extent[i], scale)
    low = int(0)
    high = int(2)
    if a[2] >= a[0] and a[2] >= a[1]:
        high = 1
    elif a[0] >= a[1]:
        low = 1
    longer = e[low] >= e[high]
    first = wp.where(longer, low, high)
    second = wp.where(longer, high, low)
    size = looks.size[m]
    texture = looks.texture[m]
    texels = wp.vec2(
        float(1 << looks.bits[texture, 0]), float(1 << looks.bits[texture, 1])
    )
    level = _copy_for(pixel * wp.max(texels[0] / size[0], texels[1] / size[1]))
    # Every instance has another offset in the pattern.
    s = q[first] / size[0] + 0.37 * float(i)
    t = q[second] / size[1] + 0.23 * float(i)
    found = _sample(looks, texture, level, s, t)
    mix = found[0] / 255.0
    shade = found[1] * SHADE_STEP
    return (looks.color[m] + (looks.color2[m] - looks.color[m]) * mix) * shade


@wp.func
def picture_color(
    looks: SceneArrays, m: int, face: int, p: wp.vec4, grow: float, pixel: float
):
    """Linear rgb of a face with an image texture at the point ``p`` (x, y, z [m], 1) in the frame of its mesh.

    ``pixel`` is the length that a pixel covers on the surface [m], ``grow`` times that its length in the mesh's frame.
    """
    texture = looks.texture[m]
    texels = float(1 << looks.bits[texture, 0]) * float(1 << looks.bits[texture, 1])
    level = _copy_for(pixel * looks.face_density[face] * grow * wp.sqrt(texels))
    s = wp.dot(looks.face_uv[face, 0], p)
    t = wp.dot(looks.face_uv[face, 1], p)
    return wp.cw_mul(looks.color[m], _linear(_sample(looks, texture, level, s, t)))
