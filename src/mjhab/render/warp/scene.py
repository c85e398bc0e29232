"""The render scene on a Warp device: one mesh of all static instances per home, and one mesh per moving shape."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from mjhab.core.errors import UsageError
from mjhab.render.raster.arrays import FACE_BITS
from mjhab.render.raster.occlusion import DISK
from mjhab.render.raster.shading import tone_curve
from mjhab.render.render_scene import RenderScene
from mjhab.render.warp.looks import SceneArrays
from mjhab.render.warp.tracing import Movers, Stills

DETAIL = 0.0005
"""Largest error of the chosen level of detail of a mesh [m]."""
BUDGET = 100_000
"""Largest number of faces of a home, and of the moving instances; the allowed error is raised until it is met."""
_RELAX = 1.5
"""Factor by which the allowed error is raised."""
_LEAF = 4
"""Faces per leaf of a home's bounding volume hierarchy."""


def choose_levels(
    scene: RenderScene, detail: float = DETAIL, budget: int = BUDGET
) -> np.ndarray:
    """Choose one level of detail per instance, for all distances.

    Args:
        scene: the meshes.
        detail: allowed error [m], raised until the budget is met or all levels are the coarsest.
        budget: largest number of faces of the static instances of a home, and of all moving instances.

    Returns:
        (I,) mesh ids.
    """
    there = present(scene)
    moving = scene.instance_body > 0
    grow = np.abs(scene.home_scale).max(axis=(0, 2))
    before = None
    while True:
        level = np.array(
            [
                _level(scene, *pair, detail)
                for pair in zip(scene.instance_mesh, grow, strict=True)
            ]
        )
        faces = scene.mesh_face_count[level]
        fits = (
            max(
                (there[:, ~moving] * faces[~moving]).sum(axis=1).max(initial=0),
                faces[moving].sum(),
            )
            <= budget
        )
        if fits or (before is not None and (scene.mesh_coarser[level] < 0).all()):
            return level
        before = level
        detail = detail * _RELAX


def _level(scene: RenderScene, mesh: int, grow: float, detail: float) -> int:
    while (
        scene.mesh_coarser[mesh] >= 0
        and scene.mesh_error[scene.mesh_coarser[mesh]] * grow <= detail
    ):
        mesh = int(scene.mesh_coarser[mesh])
    return mesh


def present(scene: RenderScene) -> np.ndarray:
    """Compute which instances each home has, (H, I) bool; missing ones have scale 0."""
    return (scene.home_scale != 0.0).all(axis=2)


class DeviceScene:
    """A render scene as Warp structs for the kernels, on the current Warp device.

    Create it inside ``wp.ScopedDevice``. The mesh of a home is missing until `add_home` builds it.

    Attributes:
        looks, stills, movers: inputs of the kernels.
        seg: (I,) i32 segment ids.

    Args:
        scene: meshes, instances and materials.

    Raises:
        UsageError: there are more moving instances, or faces in a mesh, than fit into a pixel's id; or more texels
            than an i32 can index.
    """

    def __init__(self, scene: RenderScene) -> None:
        self.scene = scene
        self._level = choose_levels(scene)
        self._there = present(scene) & (scene.instance_body == 0)
        self._meshes: dict[str, wp.Mesh] = {}
        self.seg = _ints(scene.instance_seg)
        self.looks = self._make_looks()
        self.movers = self._make_movers()
        self.stills = self._make_stills()

    def _faces(self, instance: int) -> slice:
        start = int(self.scene.mesh_face_start[self._level[instance]])
        return slice(
            start, start + int(self.scene.mesh_face_count[self._level[instance]])
        )

    def _make_looks(self) -> Any:
        scene = self.scene
        looks = SceneArrays()
        if len(scene.texels.pixels) >= 2**31:
            raise UsageError(
                "the pictures of this scene have more than 2^31 pixels; use smaller textures."
            )
        looks.face_material = _ints(scene.face_material)
        looks.face_density = _floats(scene.face_density)
        looks.face_normal = _rows(scene.face_normal, wp.vec4)
        looks.face_uv = _rows(scene.face_uv, wp.vec4)
        looks.extent = _rows(self._extent(), wp.vec3)
        looks.instance_material = _ints(scene.instance_material)
        looks.color = _rows(scene.mat_color, wp.vec3)
        looks.color2 = _rows(scene.mat_color2, wp.vec3)
        looks.texture = _ints(scene.mat_texture)
        looks.pattern = _ints(scene.mat_pattern)
        looks.size = _rows(scene.mat_size, wp.vec2)
        looks.gloss = _floats(scene.mat_gloss)
        looks.pixels = wp.array(scene.texels.pixels, dtype=wp.uint32)
        looks.start = _ints(scene.texels.start)
        looks.bits = _ints(scene.texels.bits)
        looks.tone = wp.array(tone_curve(), dtype=wp.uint8)
        looks.disk = _rows(DISK, wp.vec2)
        looks.lamp_pos = _rows(scene.light_pos, wp.vec3)
        looks.lamp_color = _rows(scene.light_color, wp.vec3)
        return looks

    def _extent(self) -> np.ndarray:
        """(I, 3) size of the finest mesh of every instance along its axes [m], without the instance's scale."""
        scene = self.scene
        sizes = {}
        for mesh in set(scene.instance_mesh.tolist()):
            first = scene.mesh_face_start[mesh]
            count = scene.mesh_face_count[mesh]
            sizes[mesh] = np.ptp(
                scene.vertices[scene.faces[first : first + count].reshape(-1)], axis=0
            )
        return np.stack([sizes[mesh] for mesh in scene.instance_mesh.tolist()])

    def _make_movers(self) -> Any:
        scene = self.scene
        movers = Movers()
        which = np.flatnonzero(scene.instance_body > 0)
        level = self._level[which]
        most = int(scene.mesh_face_count[level].max(initial=0))
        if most > 1 << FACE_BITS or len(which) >= 1 << (31 - FACE_BITS):
            raise UsageError(
                f"a mesh has {most} faces and there are {len(which)} moving instances: the device renderer supports "
                f"{1 << FACE_BITS} faces per mesh and {(1 << (31 - FACE_BITS)) - 1} moving instances."
            )
        balls = {}
        boxes = {}
        for mesh, instance in zip(level.tolist(), which.tolist(), strict=True):
            if mesh not in balls:
                corners = scene.faces[self._faces(instance)]
                used, faces = np.unique(corners, return_inverse=True)
                points = scene.vertices[used]
                self._meshes[f"mesh {mesh}"] = _mesh(points, faces)
                center = (points.min(axis=0) + points.max(axis=0)) / 2.0
                # Slightly larger, so that points rounded to float32 stay inside.
                balls[mesh] = [
                    *center,
                    1.0001 * np.linalg.norm(points - center, axis=1).max() + 1e-5,
                ]
                boxes[mesh] = 1.0001 * (points.max(axis=0) - center) + 1e-5
        movers.instance = _ints(which)
        movers.body = _ints(scene.instance_body[which])
        movers.pos = _rows(scene.instance_pos[which], wp.vec3)
        movers.mat = _rows(scene.instance_mat[which], wp.mat33)
        ids = np.array(
            [self._meshes[f"mesh {mesh}"].id for mesh in level.tolist()], np.uint64
        )
        movers.mesh = wp.array(ids, dtype=wp.uint64)
        movers.first_face = _ints(scene.mesh_face_start[level])
        movers.ball = _rows(
            np.array([balls[mesh] for mesh in level.tolist()]).reshape(-1, 4), wp.vec4
        )
        movers.half = _rows(
            np.array([boxes[mesh] for mesh in level.tolist()]).reshape(-1, 3), wp.vec3
        )
        return movers

    def _make_stills(self) -> Any:
        scene = self.scene
        stills = Stills()
        counts = (self._there * scene.mesh_face_count[self._level]).sum(axis=1)
        self._face_start = np.concatenate([[0], np.cumsum(counts)])
        stills.face_start = _ints(self._face_start[:-1])
        stills.mesh = wp.zeros(len(counts), dtype=wp.uint64)
        total = int(self._face_start[-1])
        stills.instance, stills.face = (wp.zeros(total, dtype=wp.int32) for _ in range(2))
        stills.pos = _rows(scene.home_pos, wp.vec3)
        stills.mat = _rows(scene.home_mat, wp.mat33)
        stills.scale = _rows(scene.home_scale, wp.vec3)
        return stills

    def add_home(self, home: int) -> None:
        """Build the mesh of the home with this index in the scene, unless it exists."""
        key = f"home {home}"
        scene = self.scene
        if key in self._meshes:
            return
        corners = [np.zeros((0, 3, 3))]
        sources = [np.zeros(0, int)]
        owners = [np.zeros(0, int)]
        for i in np.flatnonzero(self._there[home]).tolist():
            scale = scene.home_scale[home, i]
            faces = self._faces(i)
            points = (
                scene.vertices[scene.faces[faces]] * scale @ scene.home_mat[home, i].T
                + scene.home_pos[home, i]
            )
            corners.append(points if scale.prod() > 0.0 else points[:, ::-1])
            sources.append(np.arange(faces.start, faces.stop))
            owners.append(np.full(len(points), i))
        points, index = np.unique(
            np.concatenate(corners).reshape(-1, 3), axis=0, return_inverse=True
        )
        mesh = self._meshes[key] = _mesh(points, index)
        span = slice(int(self._face_start[home]), int(self._face_start[home + 1]))
        self.stills.instance[span].assign(np.concatenate(owners).astype(np.int32))
        self.stills.face[span].assign(np.concatenate(sources).astype(np.int32))
        self.stills.mesh[home : home + 1].assign(np.array([mesh.id], np.uint64))


def _mesh(points: np.ndarray, index: np.ndarray) -> wp.Mesh:
    return wp.Mesh(
        _rows(points, wp.vec3),
        _ints(index.reshape(-1)),
        bvh_constructor="sah",
        bvh_leaf_size=_LEAF,
    )


def _ints(values: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32)


def _floats(values: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.float32)


def _rows(values: np.ndarray, kind: Any) -> wp.array:
    """Warp array of vectors or matrices ``kind``, whose axes are the last ones of ``values``."""
    return wp.array(np.ascontiguousarray(values, np.float32), dtype=kind)
