"""Kernels that place the nodes of light of a row: points of the image, with what their light depends on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.render.jit import color_inline
from mjhab.render.raster.lighting import (
    FACING,
    GLOSS,
    NX,
    NY,
    NZ,
    OPEN,
    VX,
    VY,
    VZ,
    X,
    Y,
    Z,
    blended_share,
)
from mjhab.render.raster.surfaces import normal_at, place_point


class Openness(NamedTuple):
    """Ambient occlusion: share and depths from `occlusion.OcclusionCells`; cells: cells per pixel."""

    share: np.ndarray
    depths: np.ndarray
    cells: float


@color_inline
def world_normal(surface, poses, scratch, i, face, u, v, depth):
    """Unit normal in the world of ``face`` of instance ``i``, at a depth [m] along the ray with the slopes (u, v)."""
    px, py, pz = place_point(scratch.frames, i, u, v, depth)
    px, py, pz = normal_at(surface, scratch.frames, i, face, px, py, pz)
    rot = poses.rot
    return (
        rot[i, 0, 0] * px + rot[i, 0, 1] * py + rot[i, 0, 2] * pz,
        rot[i, 1, 0] * px + rot[i, 1, 1] * py + rot[i, 1, 2] * pz,
        rot[i, 2, 0] * px + rot[i, 2, 1] * py + rot[i, 2, 2] * pz,
    )


@color_inline
def towards_camera(lens, u, v, nx, ny, nz):
    """The normal, turned if it points away from the camera along the ray with the slopes (u, v)."""
    m = lens.mat
    away = (
        nx * (m[0, 0] * u + m[0, 1] * v - m[0, 2])
        + ny * (m[1, 0] * u + m[1, 1] * v - m[1, 2])
        + nz * (m[2, 0] * u + m[2, 1] * v - m[2, 2])
    )
    sign = -1.0 if away > 0.0 else 1.0
    return sign * nx, sign * ny, sign * nz


@color_inline
def openness_at(openness, row, col, depth):
    """Ambient openness 0..1 at a pixel of this depth [m]."""
    rows = (row + 0.5) * openness.cells
    cols = (col + 0.5) * openness.cells
    return blended_share(openness.share, openness.depths, rows, cols, depth)


@color_inline
def write_node(nodes, n, u, depth, nx, ny, nz, gloss, share):
    """Write what is known of node ``n`` before `aim_nodes`; ``u``: slope of its ray, ``depth`` [m]."""
    n = np.uint64(n)
    nodes[n + X] = u
    nodes[n + Z] = depth
    nodes[n + NX] = nx
    nodes[n + NY] = ny
    nodes[n + NZ] = nz
    nodes[n + GLOSS] = gloss
    nodes[n + OPEN] = share


@color_inline
def aim_nodes(lens, v, nodes, count):
    """Compute the points of the first ``count`` nodes of a row, the directions to the camera, and ``FACING``.

    Row X holds the slope u of each node's ray before, and Z its depth [m]; ``v`` is the slope upwards.
    """
    one = np.float32(1.0)
    v = np.float32(v)
    m = lens.mat
    right_x = np.float32(m[0, 0])
    right_y = np.float32(m[1, 0])
    right_z = np.float32(m[2, 0])
    ahead_x = np.float32(m[0, 1]) * v - np.float32(m[0, 2])
    ahead_y = np.float32(m[1, 1]) * v - np.float32(m[1, 2])
    ahead_z = np.float32(m[2, 1]) * v - np.float32(m[2, 2])
    cam_x = np.float32(lens.pos[0])
    cam_y = np.float32(lens.pos[1])
    cam_z = np.float32(lens.pos[2])
    for n in range(np.uint64(count)):
        u = nodes[n + X]
        depth = nodes[n + Z]
        rx = right_x * u + ahead_x
        ry = right_y * u + ahead_y
        rz = right_z * u + ahead_z
        inv = -one / np.sqrt(rx * rx + ry * ry + rz * rz)
        vx = rx * inv
        vy = ry * inv
        vz = rz * inv
        nodes[n + X] = cam_x + rx * depth
        nodes[n + Y] = cam_y + ry * depth
        nodes[n + Z] = cam_z + rz * depth
        nodes[n + VX] = vx
        nodes[n + VY] = vy
        nodes[n + VZ] = vz
        nodes[n + FACING] = nodes[n + NX] * vx + nodes[n + NY] * vy + nodes[n + NZ] * vz
