"""Kernels that rasterise the instances of a home into a z-buffer, and read depth and segmentation from it."""

from __future__ import annotations

import numpy as np

from mjhab.render.jit import kernel
from mjhab.render.raster.arrays import FACE_BITS
from mjhab.render.raster.fill import fill_quad
from mjhab.render.raster.meshes import draw_mesh, fitting_level
from mjhab.render.raster.sight import find_in_sight, hidden, sort_by_depth


@kernel
def draw_box(geometry, i, mesh, k, lens, inverse, ids, scratch):
    """Rasterise the sides of a box, instance ``i``, that face the camera; its map and corners have the index ``k``."""
    view = scratch.to_view
    at = scratch.corners
    middle = geometry.mesh_middle
    height, width = inverse.shape
    cx = 0.5 * width
    cy = 0.5 * height
    base = i << FACE_BITS
    c0 = view[k, 0, 3]
    c1 = view[k, 1, 3]
    c2 = view[k, 2, 3]
    for axis in range(3):
        c0 += view[k, 0, axis] * middle[mesh, axis]
        c1 += view[k, 1, axis] * middle[mesh, axis]
        c2 += view[k, 2, axis] * middle[mesh, axis]
    for axis in range(3):
        half = geometry.mesh_half[mesh, axis]
        a0 = view[k, 0, axis] * half
        a1 = view[k, 1, axis] * half
        a2 = view[k, 2, axis] * half
        square = a0 * a0 + a1 * a1 + a2 * a2
        along = a0 * c0 + a1 * c1 + a2 * c2
        if abs(along) <= square:
            continue
        # The side towards the camera has the centre c + s * a and the outward normal s * a; s is 1 for ``upper``,
        # else -1.
        upper = along < 0.0
        inv = 1.0 / (square - abs(along))
        if not upper:
            inv = -inv
        gx = a0 * inv / lens.focal
        gy = a1 * inv / lens.focal
        w0 = a2 * inv - gx * cx - gy * cy
        p = np.uint64((1 << axis) if upper else 0)
        b = np.uint64(1 << ((axis + 1) % 3))
        c = np.uint64(1 << ((axis + 2) % 3))
        side = geometry.mesh_side[mesh, 2 * axis + (1 if upper else 0)]
        fill_quad(
            inverse,
            ids,
            np.int32(base | side),
            at[k, 0, p],
            at[k, 1, p],
            at[k, 0, p | b],
            at[k, 1, p | b],
            at[k, 0, p | b | c],
            at[k, 1, p | b | c],
            at[k, 0, p | c],
            at[k, 1, p | c],
            w0,
            gx,
            gy,
        )


@kernel
def draw(geometry, placing, home, which, bodies, lens, cull, inverse, ids, scratch):
    """Rasterise the instances of a home, after `place_balls`, into ``inverse`` (h, w) f32 and ``ids`` (h, w) i32.

    The buffers are not cleared. ``which`` selects the instances: 0 all, 1 those in the world, 2 those on bodies.
    ``cull``: drop back faces. ``drawn`` of the scratch gets the level of detail of every instance.
    """
    height, width = inverse.shape
    count = find_in_sight(
        geometry, placing, home, which, bodies, lens, width, height, scratch
    )
    sort_by_depth(count, scratch)
    for n in range(count):
        k = scratch.order[n]
        i = scratch.in_sight[k]
        nearest = scratch.nearest[k]
        mesh = placing.mesh[i]
        if nearest > 0.0 and hidden(inverse, scratch.rect, k, nearest):
            continue
        if cull and nearest > 0.0 and geometry.mesh_side[mesh, 0] >= 0:
            scratch.drawn[i] = mesh
            draw_box(geometry, i, mesh, k, lens, inverse, ids, scratch)
            continue
        mesh = fitting_level(geometry, mesh, scratch, i, lens, nearest)
        scratch.drawn[i] = mesh
        draw_mesh(geometry, i, mesh, k, lens, cull, inverse, ids, scratch)


@kernel
def read_depth(inverse, out):
    """Write the planar depth [m] (0 for background) of a buffer of inverse depth (h, w) into ``out`` (h, w) f32."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            w = inverse[y, x]
            out[y, x] = np.float32(1.0) / w if w > np.float32(0.0) else np.float32(0.0)


@kernel
def read_segments(inverse, ids, instance_seg, out):
    """Write the segment id (0 for background) of every pixel into ``out`` (h, w) i32; ``instance_seg`` (I,) i32."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[y, x] = instance_seg[ids[y, x] >> FACE_BITS] if inverse[y, x] > 0.0 else 0
