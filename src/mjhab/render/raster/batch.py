"""Kernel that renders every camera of many worlds in one call per thread, without holding the GIL."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.core.kernels.counter import take_next
from mjhab.render.jit import kernel
from mjhab.render.raster.arrays import Bodies, DrawingMemory, Lens
from mjhab.render.raster.kernels import draw, read_depth, read_segments
from mjhab.render.raster.nodes import Openness
from mjhab.render.raster.occlusion import OcclusionCells, ambient_occlusion
from mjhab.render.raster.shading import ShadeScratch, shade
from mjhab.render.raster.sight import place_balls


class ViewBatch(NamedTuple):
    """Cameras and bodies of W worlds, and the images to fill.

    Attributes:
        home: (W,) i64 index of each world's home.
        looks: (W, M) i32, the material that each of the scene's is drawn as.
        body_pos, body_mat: (W, B, 3) [m], (W, B, 3, 3) f64 world poses of the bodies.
        cam_pos, cam_mat: (W, C, 3) [m], (W, C, 3, 3) f64 world poses of the cameras, as in `Lens`.
        focal: (W, C) f64 [px].
        level_error: see `Lens` [px].
        rgb, depth, seg: (W, C, h, w, 3) u8, (W, C, h, w) f32, (W, C, h, w) i32; C is 0 for outputs not requested.
    """

    home: np.ndarray
    looks: np.ndarray
    body_pos: np.ndarray
    body_mat: np.ndarray
    cam_pos: np.ndarray
    cam_mat: np.ndarray
    focal: np.ndarray
    level_error: float
    rgb: np.ndarray
    depth: np.ndarray
    seg: np.ndarray


class ThreadBuffers(NamedTuple):
    """Buffers of one thread: inverse (h, w) f32 and ids (h, w) i32 (the z-buffer, see `arrays`); flat, ``inverse`` by
    rows and a 0 behind the last pixel; cells of the ambient occlusion."""

    draw: DrawingMemory
    shade: ShadeScratch
    inverse: np.ndarray
    ids: np.ndarray
    flat: np.ndarray
    cells: OcclusionCells


@kernel
def draw_worlds(scenery, views, turn, together, near, cull, cell, stride, buffers):
    """Render the cameras that no other thread takes, in the quality "fast".

    ``turn`` (1,) i64: the first part of the work that nobody has taken yet; the threads that render one picture share
    it, so that none waits for another's slower worlds. ``together``: a part is ``together`` cameras of a world, of
    which it has a multiple. ``near``: near plane [m]; ``cull``: drop back faces; ``cell``: side of a
    cell of ambient occlusion [px]; ``stride``: distance between the pixels of a run at which light is computed [px].
    """
    inverse = buffers.inverse
    ids = buffers.ids
    poses = buffers.draw
    placing = scenery.placing
    height, width = inverse.shape
    cameras = views.cam_pos.shape[1]
    parts = len(views.home) * cameras // together
    while True:
        # Numba passes the typing context itself.
        part = take_next(turn)  # pyright: ignore[reportCallIssue]
        if part >= parts:
            return
        world = part * together // cameras
        first = part * together % cameras
        home = views.home[world]
        bodies = Bodies(views.body_pos[world], views.body_mat[world])
        place_balls(placing, home, bodies, poses)
        for camera in range(first, first + together):
            lens = Lens(
                views.cam_pos[world, camera],
                views.cam_mat[world, camera],
                views.focal[world, camera],
                near,
                views.level_error,
            )
            for y in range(height):
                for x in range(width):
                    inverse[y, x] = 0.0
            draw(
                scenery.geometry,
                placing,
                home,
                0,
                bodies,
                lens,
                cull,
                inverse,
                ids,
                poses,
            )
            if views.depth.shape[1] > 0:
                read_depth(inverse, views.depth[world, camera])
            if views.seg.shape[1] > 0:
                read_segments(inverse, ids, scenery.seg, views.seg[world, camera])
            if views.rgb.shape[1] > 0:
                ambient_occlusion(inverse, buffers.flat, cell, lens.focal, buffers.cells)
                openness = Openness(buffers.cells.share, buffers.cells.depths, 1.0 / cell)
                shade(
                    scenery.surface,
                    poses,
                    scenery.lamps,
                    home,
                    views.looks[world],
                    lens,
                    inverse,
                    ids,
                    openness,
                    scenery.tone,
                    buffers.shade,
                    stride,
                    views.rgb[world, camera],
                )
