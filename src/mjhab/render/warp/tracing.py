# type: ignore
# ruff: noqa: RUF046, UP018
# Kernels are Warp's language in the syntax of Python; its types are not those of Python. A number that changes is made
# by float() or int(), else it is a constant.
"""Kernels that find what every pixel shows, one ray each: depth, segment, and the face to be coloured.

What stands still in a home is one mesh per home in world coordinates, shared by all worlds in that home. What hangs on
bodies ("movers") is listed per tile of the picture, by bounding balls, anew in every picture. So no tree of boxes
depends on where anything is: nothing is refitted, and nothing goes stale when a world moves to another home.
"""

from __future__ import annotations

import warp as wp

from mjhab.render.raster.arrays import FACE_BITS, PARKED_BELOW

wp.set_module_options({"enable_backward": False})

TILE = wp.constant(16)
"""Side of a tile [px]."""
TILE_PIXELS = wp.constant(256)
TAG_BITS = wp.constant(FACE_BITS)
TAG_FACES = wp.constant((1 << FACE_BITS) - 1)
BURIED = wp.constant(PARKED_BELOW)
REACH = wp.constant(1000.0)
"""Nothing farther than this [m] is drawn."""
BACK_FACES = wp.constant(16)
"""Faces seen from behind that a ray passes through, at most."""
TIE = wp.constant(5.0e-5)
"""Faces nearer to each other than this [m] along a ray lie on each other."""
EDGE = wp.constant(1.0e-4)
ROUNDING = wp.constant(2.0e-6)
"""Slack at the edges of faces, as a share of them, and of coordinates."""
FAR_AWAY = wp.constant(1.0e4)
"""Bodies farther than this from the origin [m] have been thrown out of the world."""


@wp.struct
class Stills:
    """What stands in homes (H): their meshes in world coordinates, and for every face of home h, from
    ``face_start[h]`` on, the instance and the face of the render scene it is; poses and scales (H, I) of instances."""

    mesh: wp.array[wp.uint64]
    face_start: wp.array[int]
    instance: wp.array[int]
    face: wp.array[int]
    pos: wp.array2d[wp.vec3]
    mat: wp.array2d[wp.mat33]
    scale: wp.array2d[wp.vec3]


@wp.struct
class Movers:
    """What hangs on bodies (D): instance, body and pose in it; mesh, its first face in the render scene, and the ball
    around it (centre in the frame of the mesh, radius [m])."""

    instance: wp.array[int]
    body: wp.array[int]
    pos: wp.array[wp.vec3]
    mat: wp.array[wp.mat33]
    mesh: wp.array[wp.uint64]
    first_face: wp.array[int]
    ball: wp.array[wp.vec4]


@wp.struct
class Worlds:
    """Of all worlds (W): whether its pictures are wanted; home; sane: its physics has not diverged; poses of movers
    (W, D) and cameras (W, C)."""

    wanted: wp.array[bool]
    home: wp.array[int]
    sane: wp.array[bool]
    pos: wp.array2d[wp.vec3]
    mat: wp.array2d[wp.mat33]
    cam_pos: wp.array2d[wp.vec3]
    cam_mat: wp.array2d[wp.mat33]


@wp.struct
class Frame:
    """Pictures of K worlds at a time: movers per tile (K, C, T, D) and how many; inverse depth and ids (K, C, h * w).

    ids: face of the home's mesh if not negative, else ``-1 - (mover << FACE_BITS | face of its mesh)``.
    """

    focal: wp.array[float]
    width: int
    height: int
    columns: int
    near: float
    listed: wp.array3d[int]
    movers: wp.array4d[wp.int16]
    inverse: wp.array3d[float]
    ids: wp.array3d[int]


@wp.func
def is_drawn(worlds: Worlds, world: int):
    """Whether there is such a world, and its pictures are wanted; the pixels of others stay as they are."""
    if world >= worlds.wanted.shape[0]:
        return False
    return worlds.wanted[world]


@wp.func
def pixel_slopes(frame: Frame, c: int, pixel: int):
    """Slopes (to the right, up) of the ray through the middle of a pixel."""
    x = float(pixel % frame.width) + 0.5
    y = float(pixel // frame.width) + 0.5
    return wp.vec2(x - 0.5 * float(frame.width), 0.5 * float(frame.height) - y) / frame.focal[c]


@wp.func
def still_of(stills: Stills, home: int, tag: int):
    """Instance and face of the render scene that an id of a home's mesh stands for."""
    at = stills.face_start[home] + tag
    return wp.vec2i(stills.instance[at], stills.face[at])


@wp.func
def mover_of(movers: Movers, tag: int):
    """Mover and face of the render scene that a negative id stands for."""
    code = -1 - tag
    d = code >> TAG_BITS
    return wp.vec2i(d, movers.first_face[d] + (code & TAG_FACES))


@wp.kernel
def find_homes(
    row: wp.array[int], home_of_row: wp.array[int], body_pos: wp.array2d[wp.vec3], worlds: Worlds
):
    """Home of every world, and whether its bodies are where bodies can be."""
    world = wp.tid()
    worlds.home[world] = home_of_row[row[world]]
    sane = wp.bool(True)
    for b in range(body_pos.shape[1]):
        # NaN fails the comparison.
        sane = sane and wp.max(wp.abs(body_pos[world, b])) < FAR_AWAY
    worlds.sane[world] = sane


@wp.kernel
def place_cameras(
    mount: wp.array[int],
    mount_pos: wp.array[wp.vec3],
    mount_mat: wp.array[wp.mat33],
    body_pos: wp.array2d[wp.vec3],
    body_mat: wp.array2d[wp.mat33],
    worlds: Worlds,
):
    """Poses of the cameras from those of the bodies they are mounted on."""
    world, c = wp.tid()
    b = mount[c]
    worlds.cam_pos[world, c] = body_pos[world, b] + body_mat[world, b] * mount_pos[c]
    worlds.cam_mat[world, c] = body_mat[world, b] * mount_mat[c]


@wp.kernel
def place_movers(
    movers: Movers, body_pos: wp.array2d[wp.vec3], body_mat: wp.array2d[wp.mat33], worlds: Worlds
):
    """Poses of what hangs on bodies."""
    world, d = wp.tid()
    b = movers.body[d]
    worlds.pos[world, d] = body_pos[world, b] + body_mat[world, b] * movers.pos[d]
    worlds.mat[world, d] = body_mat[world, b] * movers.mat[d]


@wp.kernel
def list_movers(stills: Stills, movers: Movers, worlds: Worlds, frame: Frame, first: int):
    """Movers whose balls reach into each tile of the pictures of the worlds from ``first`` on."""
    k, c, tile = wp.tid()
    world = first + k
    frame.listed[k, c, tile] = 0
    if not is_drawn(worlds, world):
        return
    home = worlds.home[world]
    eye = worlds.cam_pos[world, c]
    axes = wp.transpose(worlds.cam_mat[world, c])
    left = TILE * (tile % frame.columns)
    top = TILE * (tile // frame.columns)
    f = frame.focal[c]
    cx = 0.5 * float(frame.width)
    cy = 0.5 * float(frame.height)
    x0 = (float(left) - cx) / f
    x1 = (float(left + TILE) - cx) / f
    y0 = (cy - float(top + TILE)) / f
    y1 = (cy - float(top)) / f
    count = int(0)
    for d in range(movers.body.shape[0]):
        scale = stills.scale[home, movers.instance[d]]
        ball = movers.ball[d]
        at = worlds.pos[world, d]
        if scale[0] * scale[1] * scale[2] == 0.0 or not at[2] > BURIED:
            continue
        center = at + worlds.mat[world, d] * wp.cw_mul(scale, wp.vec3(ball[0], ball[1], ball[2]))
        radius = ball[3] * wp.max(wp.abs(scale))
        seen = axes * (center - eye)
        x = seen[0]
        y = seen[1]
        z = -seen[2]
        if (
            z > -radius
            and x - x0 * z > -radius * wp.sqrt(1.0 + x0 * x0)
            and x1 * z - x > -radius * wp.sqrt(1.0 + x1 * x1)
            and y - y0 * z > -radius * wp.sqrt(1.0 + y0 * y0)
            and y1 * z - y > -radius * wp.sqrt(1.0 + y1 * y1)
        ):
            frame.movers[k, c, tile, count] = wp.int16(d)
            count += 1
    frame.listed[k, c, tile] = count


@wp.struct
class Hit:
    """Depth [m] (0: none) and face of a mesh."""

    depth: float
    face: int


@wp.func
def _front_at(mesh: wp.uint64, start: wp.vec3, ray: wp.vec3, depth: float):
    """Some face of a mesh, seen from its front, that a ray meets within TIE of a depth; -1 for none."""
    at = start + ray * depth
    front = int(-1)
    reach = wp.abs(ray) * (2.0 * TIE) + wp.vec3(ROUNDING * wp.max(wp.abs(at)))
    query = wp.mesh_query_aabb(mesh, at - reach, at + reach)
    face = int(0)
    while wp.mesh_query_aabb_next(query, face):
        a = wp.mesh_get_point(mesh, 3 * face)
        b = wp.mesh_get_point(mesh, 3 * face + 1)
        c = wp.mesh_get_point(mesh, 3 * face + 2)
        n = wp.cross(b - a, c - a)
        slope = wp.dot(n, ray)
        if slope < 0.0:
            t = wp.dot(n, a - start) / slope
            p = start + ray * t
            least = -EDGE * wp.dot(n, n)
            if (
                wp.abs(t - depth) <= TIE
                and wp.dot(wp.cross(b - a, p - a), n) >= least
                and wp.dot(wp.cross(c - b, p - b), n) >= least
                and wp.dot(wp.cross(a - c, p - c), n) >= least
            ):
                front = face
    return front


@wp.func
def _cast(mesh: wp.uint64, start: wp.vec3, ray: wp.vec3, near: float, far: float):
    """First face of a mesh that a ray meets from its front between two depths.

    The engine finds the first face, seen from whichever side. Where one seen from behind lies on another (sheets with
    two sides, boxes that touch), which of them comes first is chance.
    """
    hit = Hit()
    at = float(near)
    for _ in range(BACK_FACES):
        found = wp.mesh_query_ray(mesh, start + ray * at, ray, far - at)
        if not found.result:
            break
        at += found.t
        front = int(found.face)
        if wp.dot(found.normal, ray) >= 0.0:
            front = _front_at(mesh, start, ray, at)
        if front >= 0:
            hit.depth = at
            hit.face = front
            break
        at += TIE
    return hit


@wp.kernel
def trace(
    stills: Stills,
    movers: Movers,
    worlds: Worlds,
    frame: Frame,
    instance_seg: wp.array[int],
    first: int,
    depth: wp.array4d[float],
    seg: wp.array4d[int],
):
    """Cast the rays of the worlds from ``first`` on; fill what of ``depth``, ``seg`` (W, C, h, w) has cameras, and the
    frame's ``inverse`` and ``ids`` if those have."""
    k, c, ray_index = wp.tid()
    world = first + k
    # Rays of a tile are neighbours, so that threads of a warp go the same way.
    tile = ray_index // TILE_PIXELS
    within = ray_index % TILE_PIXELS
    x = TILE * (tile % frame.columns) + within % TILE
    y = TILE * (tile // frame.columns) + within // TILE
    if x >= frame.width or y >= frame.height or not is_drawn(worlds, world):
        return
    pixel = y * frame.width + x
    home = worlds.home[world]
    tag = int(0)
    best = float(0.0)
    segment = int(0)
    if worlds.sane[world]:
        slopes = pixel_slopes(frame, c, pixel)
        eye = worlds.cam_pos[world, c]
        ray = worlds.cam_mat[world, c] * wp.vec3(slopes[0], slopes[1], -1.0)
        hit = _cast(stills.mesh[home], eye, ray, frame.near, REACH)
        if hit.depth > 0.0:
            best = hit.depth
            tag = hit.face
            segment = instance_seg[still_of(stills, home, tag)[0]]
        length2 = wp.dot(ray, ray)
        for n in range(frame.listed[k, c, tile]):
            d = int(frame.movers[k, c, tile, n])
            far = wp.where(best > 0.0, best, REACH)
            scale = stills.scale[home, movers.instance[d]]
            ball = movers.ball[d]
            rot = worlds.mat[world, d]
            center = worlds.pos[world, d] + rot * wp.cw_mul(
                scale, wp.vec3(ball[0], ball[1], ball[2])
            )
            radius = ball[3] * wp.max(wp.abs(scale))
            along = wp.dot(center - eye, ray) / length2
            off = center - eye - ray * along
            room = radius * radius - wp.dot(off, off)
            if room < 0.0 or along - wp.sqrt(room / length2) > far:
                continue
            turned = wp.transpose(rot)
            start = wp.cw_div(turned * (eye - worlds.pos[world, d]), scale)
            nearer = _cast(movers.mesh[d], start, wp.cw_div(turned * ray, scale), frame.near, far)
            if nearer.depth > 0.0:
                best = nearer.depth
                tag = -1 - ((d << TAG_BITS) | nearer.face)
                segment = instance_seg[movers.instance[d]]
    if depth.shape[1] > 0:
        depth[world, c, y, x] = best
    if seg.shape[1] > 0:
        seg[world, c, y, x] = segment
    if frame.ids.shape[1] > 0:
        frame.ids[k, c, pixel] = tag
        frame.inverse[k, c, pixel] = wp.where(best > 0.0, 1.0 / best, 0.0)
