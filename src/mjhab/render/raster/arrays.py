"""Arrays that the kernels of the rasterizer work on, and what ids and depths in them mean.

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
ORDER_BUCKETS = 128
"""Instances are drawn from near to far in so many groups of like depth."""


class Geometry(NamedTuple):
    """Meshes for the kernels: every level of detail is a mesh of its own. N meshes.

    vertices (3, V) f32; faces (F, 3) i32, counted from the mesh's first vertex; planes (4, F) f32: unit normal and
    offset of every face, ``normal @ point + offset`` is above 0 in front of it; mesh_faces, mesh_verts (N, 2) i32:
    first and count; mesh_middle, mesh_half (N, 3) f64: centre and half-extents of the bounding box; mesh_ball (N, 4)
    f64: centre and radius; mesh_side (N, 6) i32: of meshes that are boxes, a face on each of the sides -x, +x, -y,
    +y, -z, +z, counted from the mesh's first face, else -1; mesh_coarser (N,) i32: the next coarser level, -1 none;
    mesh_error (N,) f64: how far the level is off [m].
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
    """Where the instances stand (arrays of RenderScene), and which are there in a home.

    ``present`` (P,) i32: instances of home h at ``start[h] : start[h + 1]``, from ``moving[h]`` on those that hang on
    bodies; ``ball`` (4, P) f32: centre [m] in the world and radius [m] of what stands in the world.
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


class Lens(NamedTuple):
    """A camera: pos (3,), mat (3, 3) f64 in MuJoCo convention; focal [px]; near [m]."""

    pos: np.ndarray
    mat: np.ndarray
    focal: float
    near: float


class Scratch(NamedTuple):
    """One thread's room, made by ``make_scratch``. I instances.

    rot (I, 3, 3), pos (I, 3), scale (I, 3) f64: world poses, of bodies' instances by ``place_instances``, of others
    when they come in sight; ball (4, I) f32, inside (I,) bool: of the instances present;
    in_sight (I,) i32, to_view (I, 3, 4), corners (I, 3, 8), nearest (I,) f64, rect (I, 4) i64: instances in sight, see
    ``sight``; order (I,) i64: their places from near to far, buckets (`ORDER_BUCKETS` + 1,) i64;
    drawn (I,) i32: mesh drawn for each instance of the current image;
    points (6, most vertices) f64, faces_inside (most faces,) bool, front (most faces,) i32, polygon (4, 3) f64: one
    mesh or triangle.
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
    faces_inside: np.ndarray
    front: np.ndarray
    polygon: np.ndarray


def make_scratch(geometry: Geometry, instances: int) -> Scratch:
    """Scratch for one thread that draws ``geometry``."""
    faces = int(geometry.mesh_faces[:, 1].max(initial=1))
    return Scratch(
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
        points=np.empty((6, int(geometry.mesh_verts[:, 1].max(initial=1)))),
        faces_inside=np.empty(faces, np.bool_),
        front=np.empty(faces + 1, np.int32),
        polygon=np.empty((4, 3)),
    )
