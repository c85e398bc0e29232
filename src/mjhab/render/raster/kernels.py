"""Kernels that rasterise the instances of a home into a z-buffer, and read depth and segmentation from it."""

from __future__ import annotations

import numpy as np

from mjhab.render.jit import kernel
from mjhab.render.raster.arrays import FACE_BITS
from mjhab.render.raster.boxes import draw_box
from mjhab.render.raster.meshes import draw_mesh, fitting_level
from mjhab.render.raster.sight import find_in_sight, hidden, sort_by_depth


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
