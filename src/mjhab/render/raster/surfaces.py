"""Kernels that compute the surface point and normal of a pixel, in the frame of its instance.

The frame of an instance has its world pose; the frame of its mesh is that divided by the instance's scale.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.render.jit import color_inline
from mjhab.render.textures import Texels


class Surface(NamedTuple):
    """Attributes of faces and materials: arrays of `RenderScene`, color to gloss without their prefix ``mat_``.

    mesh_start (N,) i32: first face of each mesh; smooth (F,) bool: the normal varies over the face; extent (I, 3): size
    of each instance's mesh along its axes [m], without the instance's scale; periods (M, 2): periods of a pattern per
    metre; density (M,): texels of level 0 along the side where they are most, per metre of a pattern, else per length
    in texture coordinates.
    """

    mesh_start: np.ndarray
    face_material: np.ndarray
    face_normal: np.ndarray
    face_uv: np.ndarray
    face_density: np.ndarray
    smooth: np.ndarray
    instance_material: np.ndarray
    extent: np.ndarray
    color: np.ndarray
    color2: np.ndarray
    texture: np.ndarray
    pattern: np.ndarray
    periods: np.ndarray
    density: np.ndarray
    gloss: np.ndarray
    texels: Texels


@color_inline
def fill_frame(poses, extent, scratch, lens, i):
    """Fill ``frames[i]`` once per image.

    Entries 0:3 are the camera's position [m] and 3:12 its rotation matrix by rows, both in the frame of instance ``i``;
    12:15 are 1 / scale, and 15:24 by rows the matrix from normals in the frame of the mesh to the world. 24 + a is the
    longer of the axes other than a, and 27 the largest of 1 / scale.
    """
    if scratch.stamp[i] == scratch.stamp[-1]:
        return
    scratch.stamp[i] = scratch.stamp[-1]
    f = scratch.frames
    rot = poses.rot
    m = lens.mat
    d0 = lens.pos[0] - poses.pos[i, 0]
    d1 = lens.pos[1] - poses.pos[i, 1]
    d2 = lens.pos[2] - poses.pos[i, 2]
    for r in range(3):
        a = rot[i, 0, r]
        b = rot[i, 1, r]
        c = rot[i, 2, r]
        f[i, r] = a * d0 + b * d1 + c * d2
        for k in range(3):
            f[i, 3 + 3 * r + k] = a * m[0, k] + b * m[1, k] + c * m[2, k]
        f[i, 12 + r] = 1.0 / poses.scale[i, r]
    for r in range(3):
        for k in range(3):
            f[i, 15 + 3 * r + k] = rot[i, r, k] * f[i, 12 + k]
    x = abs(extent[i, 0] * poses.scale[i, 0])
    y = abs(extent[i, 1] * poses.scale[i, 1])
    z = abs(extent[i, 2] * poses.scale[i, 2])
    f[i, 24] = 1.0 if y >= z else 2.0
    f[i, 25] = 0.0 if x >= z else 2.0
    f[i, 26] = 0.0 if x >= y else 1.0
    f[i, 27] = max(abs(f[i, 12]), abs(f[i, 13]), abs(f[i, 14]))


@color_inline
def place_point(f, i, u, v, depth):
    """Point [m] in the frame of instance ``i`` at a depth [m] along the ray with slopes (u right, v up)."""
    x = f[i, 0] + depth * (f[i, 3] * u + f[i, 4] * v - f[i, 5])
    y = f[i, 1] + depth * (f[i, 6] * u + f[i, 7] * v - f[i, 8])
    z = f[i, 2] + depth * (f[i, 9] * u + f[i, 10] * v - f[i, 11])
    return x, y, z


@color_inline
def normal_at(surface, f, i, face, x, y, z):
    """Normal of a face at the point (x, y, z) [m], of any length, both in the frame of instance ``i``."""
    n = surface.face_normal
    sx = f[i, 12]
    sy = f[i, 13]
    sz = f[i, 14]
    x = x * sx
    y = y * sy
    z = z * sz
    nx = (n[face, 0, 3] + n[face, 0, 0] * x + n[face, 0, 1] * y + n[face, 0, 2] * z) * sx
    ny = (n[face, 1, 3] + n[face, 1, 0] * x + n[face, 1, 1] * y + n[face, 1, 2] * z) * sy
    nz = (n[face, 2, 3] + n[face, 2, 0] * x + n[face, 2, 1] * y + n[face, 2, 2] * z) * sz
    return nx, ny, nz
