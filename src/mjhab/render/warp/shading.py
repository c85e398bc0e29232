# type: ignore
# Kernels are written in Warp's language, which has Python's syntax but its own types. A variable that changes must be
# made by float() or int(); otherwise Warp treats it as a constant.
"""Kernels that shade the faces hit by rays, per pixel: light, textures and ambient occlusion as in the CPU renderer.

They mirror ``raster.lighting`` and ``raster.shading`` and use their constants; images of the two renderers agree within
the tolerances of ``tests/render/warp/test_cameras.py``. Rays are vectors in the world, scaled to depth 1.
"""

from __future__ import annotations

import warp as wp

from mjhab.render.raster import lighting
from mjhab.render.raster.shading import TONE_RANGE
from mjhab.render.warp.looks import SceneArrays
from mjhab.render.warp.occlusion import Cells, open_share_at
from mjhab.render.warp.texturing import pattern_color, picture_color
from mjhab.render.warp.tracing import (
    Movers,
    Stills,
    TracedFrame,
    TracedWorlds,
    is_drawn,
    mover_of,
    pixel_slopes,
    still_of,
)

wp.set_module_options({"enable_backward": False})

SKY = wp.constant(wp.vec3(*lighting.SKY))
GROUND = wp.constant(wp.vec3(*lighting.GROUND))
LAMP_GAIN = wp.constant(lighting.LAMP_GAIN)
LAMP_RANGE = wp.constant(lighting.LAMP_RANGE)
FALLOFF = wp.constant(0.65 / lighting.LAMP_REACH**2)
FADE = wp.constant(1.0 / lighting.LAMP_RANGE**4)
HEAD_LIGHT = wp.constant(lighting.HEAD_LIGHT)
DULL = wp.constant(lighting.DULL)
TONE_TOP = wp.constant(TONE_RANGE)


@wp.func
def _highlight(n: wp.vec3, to_lamp: wp.vec3, to_eye: wp.vec3, gloss: float):
    """Specular factor of a lamp's light; ``n``, ``to_lamp`` and ``to_eye`` are unit vectors."""
    half = to_lamp + to_eye
    h = wp.dot(n, half) / wp.sqrt(wp.dot(half, half) + 1.0e-9)
    h4 = h * h * h * h
    h16 = h4 * h4 * h4 * h4
    return gloss * ((1.0 - gloss) * h16 + gloss * 2.0 * h16 * h16 * h16 * h16)


@wp.func
def _light(
    looks: SceneArrays,
    home: int,
    p: wp.vec3,
    n: wp.vec3,
    to_eye: wp.vec3,
    gloss: float,
    open_share: float,
):
    """Light on a point ``p`` [m] with unit normal ``n``: diffuse rgb, a factor on its colour, and specular rgb, to add.

    ``to_eye``: unit vector to the camera; ``open_share``: openness 0..1.
    """
    diffuse = wp.vec3(0.0)
    shine = wp.vec3(0.0)
    for lamp in range(looks.lamp_pos.shape[1]):
        color = looks.lamp_color[home, lamp]
        to_lamp = looks.lamp_pos[home, lamp] - p
        square = wp.dot(to_lamp, to_lamp)
        facing = wp.dot(n, to_lamp)
        if (
            facing <= 0.0
            or square > LAMP_RANGE * LAMP_RANGE
            or color[0] + color[1] + color[2] == 0.0
        ):
            continue
        inv = 1.0 / wp.sqrt(square + 1.0e-9)
        power = (
            LAMP_GAIN
            * facing
            * inv
            * (1.0 - square * square * FADE)
            / (0.35 + FALLOFF * square)
        )
        diffuse += color * power
        if gloss > DULL:
            shine += color * (power * _highlight(n, to_lamp * inv, to_eye, gloss))
    facing = wp.max(wp.dot(n, to_eye), 0.0)
    side = open_share * (1.0 + 0.10 * n[0] + 0.05 * n[1])
    away = 1.0 - facing
    rim = gloss * 0.25 * away * away * away * away * open_share
    light = GROUND * ((0.5 - 0.5 * n[2]) * side) + SKY * ((0.5 + 0.5 * n[2]) * side)
    light += diffuse * (0.35 + 0.65 * open_share) + wp.vec3(HEAD_LIGHT * facing)
    return light, shine * open_share + SKY * rim


@wp.func
def _sky(direction: wp.vec3):
    """Background colour, linear rgb, along a ray."""
    t = wp.clamp(0.5 + 0.9 * direction[2] / wp.length(direction), 0.0, 1.0)
    return wp.vec3(0.30 + 0.28 * t, 0.34 + 0.32 * t, 0.40 + 0.38 * t)


@wp.struct
class Shown:
    """Face that a pixel shows.

    instance, face: ids in the render scene. pos [m], rot: world pose of the instance. scale: of its mesh, along its
    axes.
    """

    instance: int
    face: int
    pos: wp.vec3
    rot: wp.mat33
    scale: wp.vec3


@wp.func
def _shown(
    stills: Stills, movers: Movers, worlds: TracedWorlds, world: int, home: int, tag: int
):
    """The face that an entry of ``TracedFrame.ids`` stands for."""
    shown = Shown()
    if tag >= 0:
        still = still_of(stills, home, tag)
        shown.instance = still[0]
        shown.face = still[1]
        shown.pos = stills.pos[home, shown.instance]
        shown.rot = stills.mat[home, shown.instance]
    else:
        mover = mover_of(movers, tag)
        shown.instance = movers.instance[mover[0]]
        shown.face = mover[1]
        shown.pos = worlds.pos[world, mover[0]]
        shown.rot = worlds.mat[world, mover[0]]
    shown.scale = stills.scale[home, shown.instance]
    return shown


@wp.struct
class Facing:
    """A surface point in sight of a camera.

    depth: planar [m]. q, n: point [m] and unit normal in the frame of the instance. on_mesh: point in the frame of the
    mesh, and 1. point, normal: point [m] and unit normal in the world; the normal of a flat face points to the camera.
    to_eye: unit vector. cosine: of the angle between normal and line of sight.
    """

    depth: float
    q: wp.vec3
    n: wp.vec3
    on_mesh: wp.vec4
    point: wp.vec3
    normal: wp.vec3
    to_eye: wp.vec3
    cosine: float


@wp.func
def _facing(looks: SceneArrays, shown: Shown, eye: wp.vec3, ray: wp.vec3, depth: float):
    """The point of a face at a depth [m] along a ray."""
    at = Facing()
    at.depth = depth
    at.point = eye + ray * depth
    at.q = wp.transpose(shown.rot) * (at.point - shown.pos)
    on_mesh = wp.cw_div(at.q, shown.scale)
    at.on_mesh = wp.vec4(on_mesh[0], on_mesh[1], on_mesh[2], 1.0)
    rows = wp.mat33(0.0)
    n = wp.vec3(0.0)
    for r in range(3):
        row = looks.face_normal[shown.face, r]
        n[r] = wp.dot(row, at.on_mesh) / shown.scale[r]
        rows[r] = wp.vec3(row[0], row[1], row[2])
    at.n = n / wp.sqrt(wp.dot(n, n) + 1.0e-30)
    at.normal = shown.rot * at.n
    at.to_eye = -wp.normalize(ray)
    at.cosine = wp.dot(at.normal, at.to_eye)
    if at.cosine < 0.0 and wp.ddot(rows, rows) == 0.0:
        at.normal = -at.normal
        at.cosine = -at.cosine
    return at


@wp.func
def _surface(
    looks: SceneArrays,
    home: int,
    shown: Shown,
    at: Facing,
    focal: float,
    open_share: float,
):
    """Linear rgb of a lit surface point seen by a camera with the focal length ``focal`` [px]."""
    m = looks.instance_material[home, shown.instance]
    if m < 0:
        m = looks.face_material[shown.face]
    light, shine = _light(
        looks, home, at.point, at.normal, at.to_eye, looks.gloss[m], open_share
    )
    color = looks.color[m]
    if looks.texture[m] >= 0:
        size = at.depth / (focal * wp.sqrt(wp.max(at.cosine, 0.05)))
        if looks.pattern[m] != 0:
            color = pattern_color(looks, m, shown.instance, at.q, at.n, shown.scale, size)
        else:
            grow = 1.0 / wp.min(wp.abs(shown.scale))
            color = picture_color(looks, m, shown.face, at.on_mesh, grow, size)
    return wp.cw_mul(color, light) + shine


@wp.func
def _toned(looks: SceneArrays, light: wp.vec3):
    """Tone-map linear rgb to 8-bit sRGB."""
    top = looks.tone.shape[0] - 1
    out = wp.vec3ub()
    for channel in range(3):
        level = wp.clamp(light[channel] * (float(top) / TONE_TOP), 0.0, float(top))
        out[channel] = looks.tone[int(level)]
    return out


# One kernel from ray to colour, so that intermediate results stay in registers.
@wp.kernel
def shade(
    looks: SceneArrays,
    stills: Stills,
    movers: Movers,
    worlds: TracedWorlds,
    frame: TracedFrame,
    cells: Cells,
    first: int,
    rgb: wp.array4d[wp.vec3ub],
):
    """Shade the pixels of the K worlds from ``first`` on and write them to ``rgb`` (W, C, h, w)."""
    k, c, pixel = wp.tid()
    world = first + k
    y = pixel // frame.width
    x = pixel % frame.width
    if not is_drawn(worlds, world):
        return
    if not worlds.sane[world]:
        rgb[world, c, y, x] = wp.vec3ub(wp.uint8(0), wp.uint8(0), wp.uint8(0))
        return
    slopes = pixel_slopes(frame, c, pixel)
    ray = worlds.cam_mat[world, c] * wp.vec3(slopes[0], slopes[1], -1.0)
    if frame.inverse[k, c, pixel] <= 0.0:
        rgb[world, c, y, x] = _toned(looks, _sky(ray))
        return
    home = worlds.home[world]
    depth = 1.0 / frame.inverse[k, c, pixel]
    shown = _shown(stills, movers, worlds, world, home, frame.ids[k, c, pixel])
    at = _facing(looks, shown, worlds.cam_pos[world, c], ray, depth)
    open_share = open_share_at(cells, frame, k, c, pixel, depth)
    light = _surface(looks, home, shown, at, frame.focal[c], open_share)
    rgb[world, c, y, x] = _toned(looks, light)
