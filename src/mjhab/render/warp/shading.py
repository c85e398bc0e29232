# type: ignore
# ruff: noqa: RUF046, UP018
# Kernels are written in Warp's language, which has Python's syntax but its own types. A variable that changes must be
# made by float() or int(); otherwise Warp treats it as a constant.
"""Kernels that shade the faces hit by rays, per pixel: light, textures and ambient occlusion as in the CPU renderer.

They mirror ``raster.lighting``, ``raster.shading``, ``textures`` and ``raster.occlusion`` and use their constants;
images of the two renderers agree within the tolerances of ``tests/render/warp/test_cameras.py``. A ray with slopes
(u, v) is the vector with depth 1.
"""

from __future__ import annotations

import warp as wp

from mjhab.render.patterns import SHADE_TOP
from mjhab.render.raster import lighting, occlusion
from mjhab.render.raster.shading import TONE_RANGE
from mjhab.render.textures import LEVELS
from mjhab.render.warp.tracing import (
    Frame,
    Movers,
    Stills,
    Worlds,
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
AO_RADIUS = wp.constant(occlusion.RADIUS)
AO_STRENGTH = wp.constant(occlusion.STRENGTH)
AO_TAPS = wp.constant(occlusion.TAPS)
SHADE_STEP = wp.constant(SHADE_TOP / 255.0)
LAST_LEVEL = wp.constant(LEVELS - 1)
TONE_TOP = wp.constant(TONE_RANGE)


@wp.struct
class Looks:
    """Appearance of faces (F), instances (I), materials (M) and lamps (L) of homes (H), as in ``RenderScene``.

    extent (I,): size of each instance's mesh along its axes [m]. pixels, start, bits: see ``textures.Texels``. tone:
    see ``raster.shading.tone_curve``. disk (TURNS, TAPS): sample offsets of the ambient occlusion.
    """

    face_material: wp.array[int]
    face_normal: wp.array2d[wp.vec4]
    face_uv: wp.array2d[wp.vec4]
    face_density: wp.array[float]
    extent: wp.array[wp.vec3]
    instance_material: wp.array2d[int]
    color: wp.array[wp.vec3]
    color2: wp.array[wp.vec3]
    texture: wp.array[int]
    pattern: wp.array[int]
    size: wp.array[wp.vec2]
    gloss: wp.array[float]
    pixels: wp.array[wp.uint32]
    start: wp.array2d[int]
    bits: wp.array2d[int]
    tone: wp.array[wp.uint8]
    disk: wp.array2d[wp.vec2]
    lamp_pos: wp.array2d[wp.vec3]
    lamp_color: wp.array2d[wp.vec3]


@wp.struct
class Cells:
    """Ambient occlusion of K worlds on cells of ``cell`` x ``cell`` pixels; all arrays are (K, C, height * width).

    raw, share: openness 0..1 before and after blurring. depths: inverse depth. width, height: in cells.
    """

    raw: wp.array3d[float]
    share: wp.array3d[float]
    depths: wp.array3d[float]
    width: int
    height: int
    cell: int


@wp.func
def _slope(inverse: wp.array3d[float], k: int, c: int, at: int, before: int, after: int):
    """Change of inverse depth per pixel; the smaller one-sided difference, so that depth edges have no influence."""
    w = inverse[k, c, at]
    forward = inverse[k, c, after] - w
    backward = w - inverse[k, c, before]
    if after == at:
        return backward
    if before == at:
        return forward
    return wp.where(wp.abs(forward) < wp.abs(backward), forward, backward)


@wp.kernel
def block_cells(looks: Looks, worlds: Worlds, frame: Frame, cells: Cells, first: int):
    """Compute the openness of the middle pixel of every cell, before `blur_cells`."""
    k, c, at = wp.tid()
    if not is_drawn(worlds, first + k):
        return
    i = at // cells.width
    j = at % cells.width
    y = wp.min(i * cells.cell + cells.cell // 2, frame.height - 1)
    x = wp.min(j * cells.cell + cells.cell // 2, frame.width - 1)
    pixel = y * frame.width + x
    w = frame.inverse[k, c, pixel]
    cells.depths[k, c, at] = w
    cells.raw[k, c, at] = 0.0
    if w <= 0.0:
        return
    focal = frame.focal[c]
    turn = (i & 3) * 4 + (j & 3)
    cx = 0.5 * float(frame.width)
    cy = 0.5 * float(frame.height)
    left = pixel - wp.min(x, 1)
    right = pixel + wp.min(frame.width - 1 - x, 1)
    up = pixel - frame.width * wp.min(y, 1)
    down = pixel + frame.width * wp.min(frame.height - 1 - y, 1)
    gx = _slope(frame.inverse, k, c, pixel, left, right)
    gy = _slope(frame.inverse, k, c, pixel, up, down)
    u = float(x) + 0.5 - cx
    v = float(y) + 0.5 - cy
    n = wp.vec3(-gx * focal, -gy * focal, -(w - gx * u - gy * v))
    n = n / wp.sqrt(wp.dot(n, n) + 1.0e-20)
    z = 1.0 / w
    p = wp.vec3(u / focal * z, v / focal * z, z)
    reach = wp.min(AO_RADIUS * focal * w, 0.2 * float(frame.height))
    total = float(0.0)
    for tap in range(AO_TAPS):
        offset = looks.disk[turn, tap]
        col = int(float(x) + 0.5 + reach * offset[0])
        row = int(float(y) + 0.5 + reach * offset[1])
        if col < 0 or row < 0 or col >= frame.width or row >= frame.height:
            continue
        other = frame.inverse[k, c, row * frame.width + col]
        if other <= 0.0:
            continue
        qz = 1.0 / other
        d = (
            wp.vec3((float(col) + 0.5 - cx) / focal * qz, (float(row) + 0.5 - cy) / focal * qz, qz)
            - p
        )
        square = wp.dot(d, d)
        if square < AO_RADIUS * AO_RADIUS:
            rise = wp.max(wp.dot(d, n) - 0.004 * z, 0.0)
            total += rise / wp.sqrt(square + 1.0e-4) * (1.0 - square / (AO_RADIUS * AO_RADIUS))
    cells.raw[k, c, at] = total / float(AO_TAPS)


@wp.kernel
def blur_cells(worlds: Worlds, cells: Cells, first: int):
    """Compute the openness of every cell as the mean over neighbouring cells of similar depth."""
    k, c, at = wp.tid()
    if not is_drawn(worlds, first + k):
        return
    i = at // cells.width
    j = at % cells.width
    depth = cells.depths[k, c, at]
    total = float(0.0)
    weight = float(1.0e-9)
    for y in range(wp.max(i - 2, 0), wp.min(i + 2, cells.height)):
        for x in range(wp.max(j - 2, 0), wp.min(j + 2, cells.width)):
            near = y * cells.width + x
            if wp.abs(cells.depths[k, c, near] - depth) < 0.05 * depth:
                total += cells.raw[k, c, near]
                weight += 1.0
    cells.share[k, c, at] = wp.max(1.0 - AO_STRENGTH * total / weight, 0.15)


@wp.func
def _openness(cells: Cells, k: int, c: int, row: float, col: float, depth: float):
    """Openness at a position (row, col in cells), interpolated from four cells of similar depth."""
    y = wp.max(row - 0.5, 0.0)
    x = wp.max(col - 0.5, 0.0)
    i = wp.min(int(y), cells.height - 1)
    j = wp.min(int(x), cells.width - 1)
    fy = y - float(i)
    fx = x - float(j)
    total = float(0.0)
    weight = float(1.0e-9)
    for corner in range(4):
        r = corner // 2
        q = corner % 2
        at = wp.min(i + r, cells.height - 1) * cells.width + wp.min(j + q, cells.width - 1)
        w = wp.where(r == 1, fy, 1.0 - fy) * wp.where(q == 1, fx, 1.0 - fx) + 1.0e-3
        w = w * (1.0e-4 + wp.max(0.0, 1.0 - 20.0 * wp.abs(cells.depths[k, c, at] * depth - 1.0)))
        total += w * cells.share[k, c, at]
        weight += w
    return total / weight


@wp.func
def _highlight(n: wp.vec3, to_lamp: wp.vec3, to_eye: wp.vec3, gloss: float):
    """Fraction of a lamp's light that a glossy surface reflects towards the camera."""
    half = to_lamp + to_eye
    h = wp.dot(n, half) / wp.sqrt(wp.dot(half, half) + 1.0e-9)
    h4 = h * h * h * h
    h16 = h4 * h4 * h4 * h4
    return gloss * ((1.0 - gloss) * h16 + gloss * 2.0 * h16 * h16 * h16 * h16)


@wp.func
def _light(
    looks: Looks,
    home: int,
    p: wp.vec3,
    n: wp.vec3,
    to_eye: wp.vec3,
    gloss: float,
    open_share: float,
):
    """Light on a point: the factor on its colour, and the highlights to add."""
    diffuse = wp.vec3(0.0)
    shine = wp.vec3(0.0)
    for lamp in range(looks.lamp_pos.shape[1]):
        color = looks.lamp_color[home, lamp]
        way = looks.lamp_pos[home, lamp] - p
        square = wp.dot(way, way)
        facing = wp.dot(n, way)
        if (
            facing <= 0.0
            or square > LAMP_RANGE * LAMP_RANGE
            or color[0] + color[1] + color[2] == 0.0
        ):
            continue
        inv = 1.0 / wp.sqrt(square + 1.0e-9)
        power = (
            LAMP_GAIN * facing * inv * (1.0 - square * square * FADE) / (0.35 + FALLOFF * square)
        )
        diffuse += color * power
        if gloss > DULL:
            shine += color * (power * _highlight(n, way * inv, to_eye, gloss))
    facing = wp.max(wp.dot(n, to_eye), 0.0)
    side = open_share * (1.0 + 0.10 * n[0] + 0.05 * n[1])
    away = 1.0 - facing
    rim = gloss * 0.25 * away * away * away * away * open_share
    light = GROUND * ((0.5 - 0.5 * n[2]) * side) + SKY * ((0.5 + 0.5 * n[2]) * side)
    light += diffuse * (0.35 + 0.65 * open_share) + wp.vec3(HEAD_LIGHT * facing)
    return light, shine * open_share + SKY * rim


@wp.func
def _sky(direction: wp.vec3):
    """Background colour along a ray."""
    t = wp.clamp(0.5 + 0.9 * direction[2] / wp.length(direction), 0.0, 1.0)
    return wp.vec3(0.30 + 0.28 * t, 0.34 + 0.32 * t, 0.40 + 0.38 * t)


@wp.func
def _texel(looks: Looks, at: int):
    """Red, green and blue (0..255) of a pixel of the texture pool."""
    packed = looks.pixels[at]
    low = wp.uint32(255)
    return wp.vec3(
        float(packed & low),
        float((packed >> wp.uint32(8)) & low),
        float((packed >> wp.uint32(16)) & low),
    )


@wp.func
def _sample(looks: Looks, texture: int, level: int, u: float, v: float):
    """Red, green and blue (0..255) at (u, v) of a texture, interpolated bilinearly; the texture repeats."""
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
    """Mipmap level whose texels are about as large as a pixel."""
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
def _pattern(looks: Looks, m: int, i: int, q: wp.vec3, n: wp.vec3, scale: wp.vec3, pixel: float):
    """Colour of a patterned material at the point ``q`` [m] with normal ``n``, both in the axes of the instance.

    The pattern lies in the coordinate plane that is most parallel to the face; u runs along the longer side.
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
    texels = wp.vec2(float(1 << looks.bits[texture, 0]), float(1 << looks.bits[texture, 1]))
    level = _copy_for(pixel * wp.max(texels[0] / size[0], texels[1] / size[1]))
    # Every instance has another offset in the pattern.
    s = q[first] / size[0] + 0.37 * float(i)
    t = q[second] / size[1] + 0.23 * float(i)
    found = _sample(looks, texture, level, s, t)
    mix = found[0] / 255.0
    shade = found[1] * SHADE_STEP
    return (looks.color[m] + (looks.color2[m] - looks.color[m]) * mix) * shade


@wp.func
def _picture(looks: Looks, m: int, face: int, p: wp.vec4, grow: float, pixel: float):
    """Colour of a face with an image texture at the point ``p`` of its mesh; pixels are ``grow`` times larger there."""
    texture = looks.texture[m]
    texels = float(1 << looks.bits[texture, 0]) * float(1 << looks.bits[texture, 1])
    level = _copy_for(pixel * looks.face_density[face] * grow * wp.sqrt(texels))
    s = wp.dot(looks.face_uv[face, 0], p)
    t = wp.dot(looks.face_uv[face, 1], p)
    return wp.cw_mul(looks.color[m], _linear(_sample(looks, texture, level, s, t)))


@wp.struct
class Shown:
    """Face that a pixel shows: its instance in the render scene, its number there, and the instance's world pose.

    scale: of the instance's mesh along its axes.
    """

    instance: int
    face: int
    pos: wp.vec3
    rot: wp.mat33
    scale: wp.vec3


@wp.func
def _shown(stills: Stills, movers: Movers, worlds: Worlds, world: int, home: int, tag: int):
    """The face that an entry of ``Frame.ids`` stands for."""
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

    depth: along the ray [m]. q, n: point [m] and unit normal in the axes of the instance. on_mesh: point in the frame
    of its mesh, and 1. point, normal: the same in the world; the normal of a flat face points to the camera. to_eye:
    unit vector. cosine: of the angle between normal and line of sight.
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
def _facing(looks: Looks, shown: Shown, eye: wp.vec3, ray: wp.vec3, depth: float):
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
def _open_share(cells: Cells, frame: Frame, k: int, c: int, pixel: int, depth: float):
    """Openness at a pixel of a depth [m]."""
    row = (float(pixel // frame.width) + 0.5) / float(cells.cell)
    column = (float(pixel % frame.width) + 0.5) / float(cells.cell)
    return _openness(cells, k, c, row, column, depth)


@wp.func
def _surface(looks: Looks, home: int, shown: Shown, at: Facing, focal: float, open_share: float):
    """Linear colour of a surface point seen by a camera with the focal length ``focal`` [px]."""
    m = looks.instance_material[home, shown.instance]
    if m < 0:
        m = looks.face_material[shown.face]
    light, shine = _light(looks, home, at.point, at.normal, at.to_eye, looks.gloss[m], open_share)
    color = looks.color[m]
    if looks.texture[m] >= 0:
        size = at.depth / (focal * wp.sqrt(wp.max(at.cosine, 0.05)))
        if looks.pattern[m] != 0:
            color = _pattern(looks, m, shown.instance, at.q, at.n, shown.scale, size)
        else:
            grow = 1.0 / wp.min(wp.abs(shown.scale))
            color = _picture(looks, m, shown.face, at.on_mesh, grow, size)
    return wp.cw_mul(color, light) + shine


@wp.func
def _toned(looks: Looks, light: wp.vec3):
    """The 8-bit sRGB colour of linear light."""
    top = looks.tone.shape[0] - 1
    out = wp.vec3ub()
    for channel in range(3):
        level = wp.clamp(light[channel] * (float(top) / TONE_TOP), 0.0, float(top))
        out[channel] = looks.tone[int(level)]
    return out


# One kernel from ray to colour, because every part uses intermediate results that are still in registers.
@wp.kernel
def shade(
    looks: Looks,
    stills: Stills,
    movers: Movers,
    worlds: Worlds,
    frame: Frame,
    cells: Cells,
    first: int,
    rgb: wp.array4d[wp.vec3ub],
):
    """Shade the pixels of the worlds from ``first`` on and write them to ``rgb`` (W, C, h, w)."""
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
    open_share = _open_share(cells, frame, k, c, pixel, depth)
    light = _surface(looks, home, shown, at, frame.focal[c], open_share)
    rgb[world, c, y, x] = _toned(looks, light)
