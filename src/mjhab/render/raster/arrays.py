"""Arrays of the rasterizer's kernels, and the conventions for frames, ids and depths.

View frame of every kernel: x right, y down, z forward (depth), so that a point (x, y, z) lands at column
``width / 2 + focal * x / z`` and row ``height / 2 + focal * y / z``; pixel centres lie at ``+ 0.5``.
Buffers hold inverse depth, which is linear on screen: 0 is background, larger is nearer.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

FACE_BITS = 18
"""An id of a pixel is ``instance << FACE_BITS | face of the drawn mesh``."""
PARKED_BELOW = -25.0
"""Instances whose origin lies below this height [m] are parked pieces of other homes and are not drawn."""
DIVERGED_BEYOND_M = 1e4
"""A body farther than this from the origin means that the physics has diverged."""
ORDER_BUCKETS = 128
"""Number of depth buckets of the front-to-back order of instances."""


class Geometry(NamedTuple):
    """N meshes for the kernels, in the frames of the meshes [m]; every level of detail is a mesh of its own.

    Attributes:
        vertices: (3, V) f32.
        faces: (F, 3) i32, vertices counted from the mesh's first vertex.
        planes: (4, F) f32, unit normal and offset of every face; ``normal @ point + offset`` is positive in front.
        mesh_faces, mesh_verts: (N, 2) i32, first face or vertex, and their number.
        mesh_middle, mesh_half: (N, 3) f64, centre and half-extents of the bounding box.
        mesh_ball: (N, 4) f64, centre and radius of the bounding sphere.
        mesh_side: (N, 6) i32, for meshes that are boxes a face on each of the sides -x, +x, -y, +y, -z, +z, counted
            from the mesh's first face; else -1.
        mesh_coarser: (N,) i32, the next coarser level of detail, -1 for none.
        mesh_error: (N,) f64, bound of the distance to the finest level [m].
    """

    vertices: np.ndarray
    faces: np.ndarray
    planes: np.ndarray
    mesh_faces: np.ndarray
    mesh_verts: np.ndarray
    mesh_middle: np.ndarray
    mesh_half: np.ndarray
    mesh_ball: np.ndarray
    mesh_side: np.ndarray
    mesh_coarser: np.ndarray
    mesh_error: np.ndarray


class Placing(NamedTuple):
    """Poses of the instances (arrays of `RenderScene` without their prefix ``instance_``), and which a home has.

    Attributes:
        present: (P,) i32 instance ids; those of home h are ``present[start[h] : start[h + 1]]``, of which those
            attached to bodies begin at ``moving[h]``.
        ball: (4, P) f32, bounding sphere of each: centre in the frame of its body or the world, and radius [m].
    """

    mesh: np.ndarray
    body: np.ndarray
    pos: np.ndarray
    mat: np.ndarray
    home_pos: np.ndarray
    home_mat: np.ndarray
    home_scale: np.ndarray
    present: np.ndarray
    start: np.ndarray
    moving: np.ndarray
    ball: np.ndarray


class Bodies(NamedTuple):
    """World poses of the bodies of one world: pos (B, 3) [m], mat (B, 3, 3) f64."""

    pos: np.ndarray
    mat: np.ndarray


class Lens(NamedTuple):
    """A camera: world pose pos (3,) [m], mat (3, 3) f64 in MuJoCo's convention (x right, y up, z backwards); focal
    length [px]; near plane [m]; level_error [px]: largest projected error of a level of detail that is drawn."""

    pos: np.ndarray
    mat: np.ndarray
    focal: float
    near: float
    level_error: float


class DrawingMemory(NamedTuple):
    """Working memory of one thread, made by `make_scratch`. I instances, V and F: most vertices and faces of a mesh.

    Attributes:
        rot, pos, scale: (I, 3, 3), (I, 3) [m], (I, 3) f64, world poses and scales of the instances in sight, by id.
        ball, inside: (4, I) f32 and (I,) bool, bounding spheres in the world of the instances present in the home,
            and whether they intersect the frustum.
        in_sight: (I + 1,) i32, ids of the instances in sight; the next four arrays are in their order.
        to_view: (I, 3, 4) f64, affine map from the mesh to the view frame.
        corners: (I, 3, 8) f64, column, row, inverse depth of the corners of the bounding box.
        nearest: (I,) f64, smallest depth [m]; 0 if the box crosses the near plane.
        rect: (I, 4) i64, first column, last column + 1, first row, last row + 1 of the box.
        order: (I,) i64, indices into ``in_sight``, front to back; buckets: (`ORDER_BUCKETS` + 1,) i64, for sorting.
        drawn: (I,) i32, level of detail drawn for each instance of the current image, by id.
        points: (6, V) f64, vertices of the current mesh in the view frame and projected.
        cells: (V,) i32, between which columns and rows of pixel centres these lie, see `meshes._cell`.
        faces_inside, front: (F,) bool, (F + 1,) i32, back-face culling of the current mesh.
        polygon: (4, 3) f64, the current triangle, clipped at the near plane.
    """

    rot: np.ndarray
    pos: np.ndarray
    scale: np.ndarray
    ball: np.ndarray
    inside: np.ndarray
    in_sight: np.ndarray
    to_view: np.ndarray
    corners: np.ndarray
    nearest: np.ndarray
    rect: np.ndarray
    order: np.ndarray
    buckets: np.ndarray
    drawn: np.ndarray
    points: np.ndarray
    cells: np.ndarray
    faces_inside: np.ndarray
    front: np.ndarray
    polygon: np.ndarray


def make_scratch(geometry: Geometry, instances: int) -> DrawingMemory:
    """Allocate the scratch of one thread that draws ``geometry`` with this number of instances."""
    faces = int(geometry.mesh_faces[:, 1].max(initial=1))
    vertices = int(geometry.mesh_verts[:, 1].max(initial=1))
    return DrawingMemory(
        rot=np.empty((instances, 3, 3)),
        pos=np.empty((instances, 3)),
        scale=np.empty((instances, 3)),
        ball=np.empty((4, instances), np.float32),
        inside=np.empty(instances, np.bool_),
        in_sight=np.empty(instances + 1, np.int32),
        to_view=np.empty((instances, 3, 4)),
        corners=np.empty((instances, 3, 8)),
        nearest=np.empty(instances),
        rect=np.empty((instances, 4), np.int64),
        order=np.empty(instances, np.int64),
        buckets=np.empty(ORDER_BUCKETS + 1, np.int64),
        drawn=np.zeros(instances, np.int32),
        points=np.empty((6, vertices)),
        cells=np.empty(vertices, np.int32),
        faces_inside=np.empty(faces, np.bool_),
        front=np.empty(faces + 1, np.int32),
        polygon=np.empty((4, 3)),
    )
