"""Precompute the arrays of a scene for the kernels: bounds of meshes and instances, planes of faces, box meshes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.render.raster.arrays import FACE_BITS, PARKED_BELOW, Geometry, Placing
from mjhab.render.raster.lighting import Lamps
from mjhab.render.raster.shading import tone_curve
from mjhab.render.raster.surfaces import Surface
from mjhab.render.render_scene import RenderScene

BOX_FACES = 12


class Scenery(NamedTuple):
    """All inputs of the kernels that are constant over images.

    seg (I,) i32: segment id of every instance; tone: see `shading.tone_curve`.
    """

    geometry: Geometry
    placing: Placing
    surface: Surface
    lamps: Lamps
    seg: np.ndarray
    tone: np.ndarray


def make_scenery(scene: RenderScene) -> Scenery:
    """Compute the kernels' inputs from a scene.

    Raises:
        UsageError: more instances or faces in a mesh than fit in the id of a pixel.
    """
    geometry = _geometry(scene)
    smooth = np.ascontiguousarray(scene.face_normal[:, :, :3].any((1, 2)))
    surface = Surface(
        scene.mesh_face_start,
        scene.face_material,
        scene.face_normal,
        scene.face_uv,
        scene.face_density,
        smooth,
        scene.instance_material,
        2.0 * geometry.mesh_half[scene.instance_mesh],
        scene.mat_color,
        scene.mat_color2,
        scene.mat_texture,
        scene.mat_pattern,
        1.0 / scene.mat_size,
        _densities(scene),
        scene.mat_gloss,
        scene.texels,
    )
    lamps = Lamps(scene.light_pos, scene.light_color, np.empty((0, 1, 1), np.float32))
    placing = _placing(scene, geometry)
    return Scenery(geometry, placing, surface, lamps, scene.instance_seg, tone_curve())


def _densities(scene: RenderScene) -> np.ndarray:
    """See `Surface`; 0 for materials without a texture."""
    textured = scene.mat_texture >= 0
    sides = np.zeros((len(textured), 2))
    sides[textured] = 2.0 ** scene.texels.bits[scene.mat_texture[textured]]
    pattern = (sides / scene.mat_size).max(axis=1)
    return np.where(scene.mat_pattern, pattern, np.sqrt(sides.prod(axis=1)))


def _placing(scene: RenderScene, geometry: Geometry) -> Placing:
    there = (scene.home_scale != 0.0).all(axis=2)
    still = there & (scene.instance_body == 0) & (scene.home_pos[:, :, 2] > PARKED_BELOW)
    moving = there & (scene.instance_body != 0)
    rows = [
        np.flatnonzero(part) for pair in zip(still, moving, strict=True) for part in pair
    ]
    ends = np.cumsum([0, *map(len, rows)])
    present = np.concatenate(rows).astype(np.int32)
    home = np.repeat(np.arange(len(there)), np.diff(ends[::2]))
    ball = geometry.mesh_ball[scene.instance_mesh[present]]
    scale = scene.home_scale[home, present]
    world = scene.instance_body[present, None] == 0
    pos = np.where(world, scene.home_pos[home, present], scene.instance_pos[present])
    mat = np.where(
        world[..., None], scene.home_mat[home, present], scene.instance_mat[present]
    )
    center = pos + np.einsum("prc,pc->pr", mat, scale * ball[:, :3])
    radius = ball[:, 3] * np.abs(scale).max(axis=1)
    return Placing(
        scene.instance_mesh,
        scene.instance_body,
        scene.instance_pos,
        scene.instance_mat,
        scene.home_pos,
        scene.home_mat,
        scene.home_scale,
        present,
        # Of one home they would be contiguous without a copy, and the kernels compiled once more.
        ends[::2].copy(),
        ends[1::2].copy(),
        np.ascontiguousarray(
            np.concatenate([center, radius[:, None]], axis=1).T, np.float32
        ),
    )


def _geometry(scene: RenderScene) -> Geometry:
    most = int(scene.mesh_face_count.max(initial=0)), len(scene.instance_mesh)
    if most[0] > 1 << FACE_BITS or most[1] > 1 << (31 - FACE_BITS):
        raise UsageError(
            f"a mesh of {most[0]} faces or {most[1]} instances: the rasterizer draws up to {1 << FACE_BITS} faces per "
            f"mesh and {1 << (31 - FACE_BITS)} instances."
        )
    spans = np.stack([scene.mesh_face_start, scene.mesh_face_count], 1).astype(np.int32)
    verts = np.zeros_like(spans)
    faces = scene.faces.copy()
    middle = np.zeros((len(spans), 3))
    half = np.zeros((len(spans), 3))
    ball = np.zeros((len(spans), 4))
    side = np.full((len(spans), 6), -1, np.int32)
    for k, (start, count) in enumerate(spans):
        if count == 0:
            continue
        used = faces[start : start + count]
        first = used.min()
        verts[k] = first, used.max() - first + 1
        corners = scene.vertices[np.unique(used)].astype(np.float64)
        used -= first
        low = corners.min(0)
        high = corners.max(0)
        middle[k] = (low + high) / 2
        half[k] = (high - low) / 2
        ball[k, :3] = middle[k]
        ball[k, 3] = np.linalg.norm(corners - middle[k], axis=1).max() * (1.0 + 1e-9)
        side[k] = _box_sides(scene, start, count, middle[k], half[k])
    return Geometry(
        np.ascontiguousarray(scene.vertices.T),
        faces,
        _planes(scene),
        spans,
        verts,
        middle,
        half,
        ball,
        side,
        scene.mesh_coarser,
        scene.mesh_error,
    )


def _planes(scene: RenderScene) -> np.ndarray:
    """Unit normal and offset (4, F) f32 of the plane of every face; a face without area has a normal of zeros."""
    a, b, c = (scene.vertices[scene.faces[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    offset = -np.einsum("fk,fk->f", normal, a)
    return np.ascontiguousarray(
        np.concatenate([normal, offset[:, None]], axis=1).T, np.float32
    )


def _box_sides(
    scene: RenderScene, start: int, count: int, middle: np.ndarray, half: np.ndarray
) -> np.ndarray:
    """First face (6,) on the sides -x, +x, -y, +y, -z, +z of a mesh, or -1 if it is no box.

    A mesh counts as a box if it is closed, axis-aligned, and both triangles of every side have the same attributes.
    """
    none = np.full(6, -1, np.int32)
    if count != BOX_FACES or not half.all():
        return none
    rows = slice(start, start + count)
    corners = (scene.vertices[scene.faces[rows]].astype(np.float64) - middle) / half
    if np.abs(np.abs(corners) - 1.0).max() > 1e-5:
        return none
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normal).argmax(axis=1)
    size = np.take_along_axis(normal, axis[:, None], 1)[:, 0]
    number = 2 * axis + (size > 0.0)
    # Each triangle has half the area of its side; ``apart`` tells below whether the two overlap.
    if (np.bincount(number, minlength=6) != 2).any() or np.abs(
        np.abs(size) - 4.0
    ).max() > 1e-4:
        return none
    order = np.argsort(number, kind="stable").reshape(6, 2)
    at = np.take_along_axis(corners.mean(axis=1), axis[:, None], 1)[:, 0]
    outward = (at * size > 0.0).all()
    apart = np.abs(corners[order[:, 0]].mean(1) + corners[order[:, 1]].mean(1)).max(
        axis=1
    )
    looks = [scene.face_material, scene.face_normal, scene.face_uv, scene.face_density]
    alike = all(
        np.allclose(look[rows][order[:, 0]], look[rows][order[:, 1]], atol=1e-5)
        for look in looks
    )
    return (
        order[:, 0].astype(np.int32)
        if outward and alike and np.allclose(apart, 2.0)
        else none
    )
