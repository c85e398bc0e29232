# type: ignore
# ruff: noqa: RUF046, UP018
# Kernels are written in Warp's language, which has Python's syntax but its own types. A variable that changes must be
# made by float() or int(); otherwise Warp treats it as a constant.
"""Kernels that cast one ray per pixel and find its depth, segment, and the face to shade.

The static instances of a home ("stills") form one mesh in the world frame, shared by all worlds in that home. Moving
instances ("movers", attached to bodies) are assigned to tiles of the image by their bounding spheres, anew for every
image. No bounding volume hierarchy depends on poses, so none is refitted, also when a world moves to another home.

W worlds, H homes, I instances of the render scene, D movers, C cameras, K worlds rendered together, T tiles per image.
"""

from __future__ import annotations

import warp as wp

from mjhab.render.raster.arrays import DIVERGED_BEYOND_M, FACE_BITS, PARKED_BELOW

wp.set_module_options({"enable_backward": False})

TILE = wp.constant(16)
"""Side of a tile [px]."""
TILE_PIXELS = wp.constant(256)
"""Pixels of a tile."""
TAG_BITS = wp.constant(FACE_BITS)
TAG_FACES = wp.constant((1 << FACE_BITS) - 1)
BURIED = wp.constant(PARKED_BELOW)
REACH = wp.constant(1000.0)
"""Largest distance of a hit [m]."""
BACK_FACES = wp.constant(16)
"""Largest number of back faces that a ray passes through."""
TIE = wp.constant(5.0e-5)
"""Faces closer to each other along a ray than this count as coincident [m]."""
EDGE = wp.constant(1.0e-4)
"""Tolerance of barycentric coordinates at the edges of faces."""
ROUNDING = wp.constant(2.0e-6)
"""Relative rounding error of float32 coordinates."""
FAR_AWAY = wp.constant(DIVERGED_BEYOND_M)


@wp.struct
class Stills:
    """Static instances of the homes.

    mesh (H,): id of each home's mesh, in the world frame; 0 until it is built. instance, face: instance and face in the
    render scene of every face of these meshes; those of home h start at ``face_start[h]``. pos [m], mat, scale (H, I):
    world poses of static instances and scales of all instances.
    """

    mesh: wp.array[wp.uint64]
    face_start: wp.array[int]
    instance: wp.array[int]
    face: wp.array[int]
    pos: wp.array2d[wp.vec3]
    mat: wp.array2d[wp.mat33]
    scale: wp.array2d[wp.vec3]


@wp.struct
class Movers:
    """D moving instances, which are attached to bodies; all arrays are (D,).

    instance: id in the render scene. body: body id in the MjModel. pos [m], mat: pose in the body's frame. mesh: id of
    its mesh. first_face: first face of the mesh in the render scene. ball: bounding sphere (centre and radius [m] in
    the frame of the mesh). half: half edges of the bounding box about the same centre [m], along the mesh's axes.
    """

    instance: wp.array[int]
    body: wp.array[int]
    pos: wp.array[wp.vec3]
    mat: wp.array[wp.mat33]
    mesh: wp.array[wp.uint64]
    first_face: wp.array[int]
    ball: wp.array[wp.vec4]
    half: wp.array[wp.vec3]


@wp.struct
class TracedWorlds:
    """State of all W worlds.

    wanted (W,): its images are to be rendered. home (W,): index of its home. sane (W,): its physics has not diverged.
    pos [m], mat (W, D): world poses of movers. cam_pos [m], cam_mat (W, C): world poses of cameras (x right, y up, z
    backwards).
    """

    wanted: wp.array[bool]
    home: wp.array[int]
    sane: wp.array[bool]
    pos: wp.array2d[wp.vec3]
    mat: wp.array2d[wp.mat33]
    cam_pos: wp.array2d[wp.vec3]
    cam_mat: wp.array2d[wp.mat33]


@wp.struct
class TracedFrame:
    """Intermediate results of K worlds that are rendered together.

    focal (C,): focal lengths [px]. width, height: of the images [px]. columns: tiles per row. near: nearest depth [m].
    movers (K, C, T, D): indices of the movers in a tile. listed (K, C, T): their number. inverse (K, C, h * w): inverse
    depth [1/m], 0 for background. ids (K, C, h * w): face of the home's mesh if not negative, else
    ``-1 - (mover << FACE_BITS | face of its mesh)``.
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
def is_drawn(worlds: TracedWorlds, world: int):
    """Whether the world exists and its images are requested; the pixels of other worlds stay unchanged."""
    if world >= worlds.wanted.shape[0]:
        return False
    return worlds.wanted[world]


@wp.func
def pixel_slopes(frame: TracedFrame, c: int, pixel: int):
    """Slopes (right, up) of the ray through the centre of a pixel (row * width + column) of camera ``c``."""
    x = float(pixel % frame.width) + 0.5
    y = float(pixel // frame.width) + 0.5
    return (
        wp.vec2(x - 0.5 * float(frame.width), 0.5 * float(frame.height) - y)
        / frame.focal[c]
    )


@wp.func
def still_of(stills: Stills, home: int, tag: int):
    """Instance and face in the render scene of a static face, given its id ``tag`` in ``TracedFrame.ids``."""
    at = stills.face_start[home] + tag
    return wp.vec2i(stills.instance[at], stills.face[at])


@wp.func
def mover_of(movers: Movers, tag: int):
    """Index of the mover, and face in the render scene, of a mover's face, by its id ``tag`` in ``TracedFrame.ids``."""
    code = -1 - tag
    d = code >> TAG_BITS
    return wp.vec2i(d, movers.first_face[d] + (code & TAG_FACES))


@wp.kernel
def find_homes(
    row: wp.array[int],
    home_of_row: wp.array[int],
    body_pos: wp.array2d[wp.vec3],
    worlds: TracedWorlds,
):
    """Set the home of every world and whether its physics is sane (all body positions finite and near)."""
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
    worlds: TracedWorlds,
):
    """Compute the world poses of the cameras from those of the bodies they are mounted on."""
    world, c = wp.tid()
    b = mount[c]
    worlds.cam_pos[world, c] = body_pos[world, b] + body_mat[world, b] * mount_pos[c]
    worlds.cam_mat[world, c] = body_mat[world, b] * mount_mat[c]


@wp.kernel
def place_movers(
    movers: Movers,
    body_pos: wp.array2d[wp.vec3],
    body_mat: wp.array2d[wp.mat33],
    worlds: TracedWorlds,
):
    """Compute the world poses of the movers from those of their bodies."""
    world, d = wp.tid()
    b = movers.body[d]
    worlds.pos[world, d] = body_pos[world, b] + body_mat[world, b] * movers.pos[d]
    worlds.mat[world, d] = body_mat[world, b] * movers.mat[d]


@wp.func
def _box_reach(axes: wp.mat33, half: wp.vec3, normal: wp.vec3):
    """Largest distance of a point of a box from its centre along ``normal``; the columns of ``axes`` are its edges."""
    along = wp.transpose(axes) * normal
    return wp.dot(wp.vec3(wp.abs(along[0]), wp.abs(along[1]), wp.abs(along[2])), half)


@wp.kernel
def list_movers(
    stills: Stills, movers: Movers, worlds: TracedWorlds, frame: TracedFrame, first: int
):
    """List the movers whose bounding boxes reach into the view of each image tile, for the worlds from ``first`` on."""
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
    # Inward normals of the sides of the pyramid, in the camera's axes (z backwards).
    left_side = wp.vec3(1.0, 0.0, x0)
    right_side = wp.vec3(-1.0, 0.0, -x1)
    bottom_side = wp.vec3(0.0, 1.0, y0)
    top_side = wp.vec3(0.0, -1.0, -y1)
    count = int(0)
    for d in range(movers.body.shape[0]):
        scale = stills.scale[home, movers.instance[d]]
        ball = movers.ball[d]
        at = worlds.pos[world, d]
        if scale[0] * scale[1] * scale[2] == 0.0 or not at[2] > BURIED:
            continue
        rot = worlds.mat[world, d]
        seen = axes * (
            at + rot * wp.cw_mul(scale, wp.vec3(ball[0], ball[1], ball[2])) - eye
        )
        edges = axes * rot
        half = wp.cw_mul(
            wp.vec3(wp.abs(scale[0]), wp.abs(scale[1]), wp.abs(scale[2])), movers.half[d]
        )
        # A box is tighter than a sphere about doors and boards: fewer rays ask for a mesh that they miss.
        if (
            -seen[2] > -_box_reach(edges, half, wp.vec3(0.0, 0.0, 1.0))
            and wp.dot(left_side, seen) > -_box_reach(edges, half, left_side)
            and wp.dot(right_side, seen) > -_box_reach(edges, half, right_side)
            and wp.dot(bottom_side, seen) > -_box_reach(edges, half, bottom_side)
            and wp.dot(top_side, seen) > -_box_reach(edges, half, top_side)
        ):
            frame.movers[k, c, tile, count] = wp.int16(d)
            count += 1
    frame.listed[k, c, tile] = count


@wp.struct
class Hit:
    """Depth [m] (0 for no hit) and face of a mesh."""

    depth: float
    face: int


@wp.func
def _front_at(mesh: wp.uint64, start: wp.vec3, ray: wp.vec3, depth: float):
    """A front face of a mesh that a ray hits within `TIE` of a depth; -1 for none."""
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
    """First front face of a mesh that a ray hits between two depths [m].

    Warp's query returns the first hit of a front or back face. Where a back face coincides with a front face (two-sided
    sheets, touching boxes), it may return either of them, so a back face is checked for a coincident front face.
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


@wp.func
def _misses_box(center: wp.vec3, half: wp.vec3, start: wp.vec3, ray: wp.vec3, far: float):
    """Whether a ray misses a box along the axes, or enters it beyond the depth ``far`` [m]."""
    enter = float(0.0)
    leave = float(far)
    for i in range(3):
        # A ray along a face has an infinite quotient, or none (NaN) on the face itself, which no comparison accepts.
        inverse = 1.0 / ray[i]
        a = (center[i] - half[i] - start[i]) * inverse
        b = (center[i] + half[i] - start[i]) * inverse
        enter = wp.max(enter, wp.min(a, b))
        leave = wp.min(leave, wp.max(a, b))
    return enter > leave


# One kernel from ray to nearest hit, so that the ray and the nearest depth so far stay in registers.
@wp.kernel
def trace(
    stills: Stills,
    movers: Movers,
    worlds: TracedWorlds,
    frame: TracedFrame,
    instance_seg: wp.array[int],
    first: int,
    depth: wp.array4d[float],
    seg: wp.array4d[int],
):
    """Cast the rays of the K worlds from ``first`` on.

    Writes ``depth`` [m] and ``seg`` (W, C, h, w), and the frame's ``inverse`` and ``ids``, each unless it is empty.
    """
    k, c, ray_index = wp.tid()
    world = first + k
    # Rays of a tile have neighbouring indices, so that the threads of a GPU warp take similar paths.
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
        for n in range(frame.listed[k, c, tile]):
            d = int(frame.movers[k, c, tile, n])
            far = wp.where(best > 0.0, best, REACH)
            scale = stills.scale[home, movers.instance[d]]
            turned = wp.transpose(worlds.mat[world, d])
            start = wp.cw_div(turned * (eye - worlds.pos[world, d]), scale)
            along = wp.cw_div(turned * ray, scale)
            ball = movers.ball[d]
            center = wp.vec3(ball[0], ball[1], ball[2])
            if _misses_box(center, movers.half[d], start, along, far):
                continue
            nearer = _cast(movers.mesh[d], start, along, frame.near, far)
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
