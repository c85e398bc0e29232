"""Compiled drawing of whole worlds: every camera of a range of worlds in one call, without the interpreter lock."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.render.raster.arrays import Lens, Scratch
from mjhab.render.raster.jit import kernel
from mjhab.render.raster.kernels import draw, read_depth, read_segments
from mjhab.render.raster.occlusion import ambient_occlusion
from mjhab.render.raster.shading import Openness, ShadeScratch, shade
from mjhab.render.raster.sight import place_instances


class Views(NamedTuple):
    """Cameras and bodies of W worlds, and the images to fill (of no cameras: not wanted).

    home (W,) i64; body_pos (W, B, 3), body_mat (W, B, 3, 3), cam_pos (W, C, 3), cam_mat (W, C, 3, 3) f64;
    focal (C,) f64 [px]; rgb (W, C, h, w, 3) u8; depth (W, C, h, w) f32; seg (W, C, h, w) i32.
    """

    home: np.ndarray
    body_pos: np.ndarray
    body_mat: np.ndarray
    cam_pos: np.ndarray
    cam_mat: np.ndarray
    focal: np.ndarray
    rgb: np.ndarray
    depth: np.ndarray
    seg: np.ndarray


class Room(NamedTuple):
    """One thread's buffers: inverse (h, w) f32, ids (h, w) i32; raw, share, depths (a, b) f32 of the occlusion."""

    draw: Scratch
    shade: ShadeScratch
    inverse: np.ndarray
    ids: np.ndarray
    raw: np.ndarray
    share: np.ndarray
    depths: np.ndarray


@kernel
def draw_worlds(scenery, views, first, last, near, cull, cell, stride, room):
    """Draw all cameras of the worlds ``first`` to ``last`` in the quality "fast".

    ``cell``: pixels per cell of ambient occlusion; ``stride``: pixels between nodes of light.
    """
    inverse = room.inverse
    ids = room.ids
    poses = room.draw
    placing = scenery.placing
    height, width = inverse.shape
    for world in range(first, last):
        home = views.home[world]
        place_instances(
            scenery.geometry, placing, home, views.body_pos[world], views.body_mat[world], poses
        )
        for camera in range(views.cam_pos.shape[1]):
            lens = Lens(
                views.cam_pos[world, camera],
                views.cam_mat[world, camera],
                views.focal[camera],
                near,
            )
            for y in range(height):
                for x in range(width):
                    inverse[y, x] = 0.0
            draw(scenery.geometry, placing, home, 0, lens, cull, inverse, ids, poses)
            if views.depth.shape[1] > 0:
                read_depth(inverse, views.depth[world, camera])
            if views.seg.shape[1] > 0:
                read_segments(inverse, ids, scenery.seg, views.seg[world, camera])
            if views.rgb.shape[1] > 0:
                ambient_occlusion(inverse, cell, lens.focal, room.raw, room.share, room.depths)
                openness = Openness(room.share, room.depths, 1.0 / cell)
                shade(
                    scenery.surface,
                    poses,
                    scenery.lamps,
                    home,
                    lens,
                    inverse,
                    ids,
                    openness,
                    scenery.tone,
                    room.shade,
                    stride,
                    views.rgb[world, camera],
                )
