"""Build a `RenderScene` from geoms, meshes, materials, textures, instances and lamps."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.rotations import mat_from_quat
from mjhab.core.typed.checks import check, check_between
from mjhab.render.mesh_levels import Level, mesh_levels
from mjhab.render.patterns import PERIODS
from mjhab.render.primitives import capsule_mesh, primitive_mesh
from mjhab.render.render_scene import RenderScene
from mjhab.render.textures import TexturePool
from mjhab.scenes.builtin.materials import MATERIALS, Material
from mjhab.scenes.shapes.colors import srgb_to_linear
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import Geom, Light, Vec3

UNIT: Vec3 = (1.0, 1.0, 1.0)
PLAIN_FACE = 0
"""Id of the light grey material of meshes without colours or textures of their own."""
MESH_GLOSS = 0.2
"""Gloss (0 to 1) of meshes with colours or textures of their own."""


def _pick(textures: tuple[np.ndarray, ...], number: int) -> np.ndarray | None:
    return textures[number] if number >= 0 else None


@dataclass(frozen=True, eq=False)
class _HomeLook:
    """Pose, scale and material of an instance in H homes; each may be one value for all homes.

    pos (H, 3) [m], mat (H, 3, 3), scale (H, 3), material (H,) ids, -1 for the colours of the mesh.
    """

    pos: ArrayLike
    mat: ArrayLike
    scale: ArrayLike
    material: ArrayLike


class SceneBuilder:
    """Collect meshes, materials, instances and lamps of a layout; `build` returns the `RenderScene`.

    Args:
        num_homes: number of homes H in the layout.
        materials: materials by name, for `material`.
    """

    def __init__(
        self, num_homes: int, materials: Mapping[str, Material] = MATERIALS
    ) -> None:
        self.num_homes = num_homes
        self._named = dict(materials)
        self._materials: dict[tuple[Material, int], int] = {}
        self._textures = TexturePool()
        self._meshes: dict[Hashable, int] = {}
        self._levels: list[Level] = []
        self._face_materials: list[np.ndarray] = []
        self._coarser: list[int] = []
        self._instances: list[tuple[int, int, int]] = []
        self._local: list[tuple[np.ndarray, np.ndarray]] = []
        self._home_pose: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self._home_material: list[np.ndarray] = []
        # Pixels that show nothing are 0 in an image of zeros.
        self._segments: dict[str, int] = {"background": 0}
        self._lights: list[list[Light]] = [[] for _ in range(num_homes)]
        # The first one, so that its id is `PLAIN_FACE`.
        self.add_material(Material((0.8, 0.8, 0.8)))

    def add_material(self, material: Material, texture: np.ndarray | None = None) -> int:
        """Add a material and return its id; equal materials share an id.

        Args:
            material: its colour is multiplied with the texture.
            texture: image (h, w, 3) uint8 sRGB, mapped by the mesh's uv (see `scenes.shapes.meshes.Mesh`); or None.

        Raises:
            UsageError: the sides of the texture are not powers of two, or are too large.
        """
        number = -1
        if texture is not None:
            number = self._textures.add(texture)
        elif material.pattern != "plain":
            number = self._textures.add_pattern(material.pattern)
        return self._materials.setdefault((material, number), len(self._materials))

    def material(self, name: str) -> int:
        """Return the id of the named material.

        Raises:
            UsageError: there is no such material; the message has the nearest name.
        """
        if name not in self._named:
            raise unknown_name("material", name, self._named)
        return self.add_material(self._named[name])

    def segment(self, name: str) -> int:
        """Return the id of a name in segmentation images, new names getting the next id; 0 is "background"."""
        return self._segments.setdefault(name, len(self._segments))

    def add_mesh(self, key: Hashable, mesh: Mesh) -> int:
        """Add a mesh with its levels of detail and return the id of its finest level.

        Args:
            key: identifies the mesh; if it was added before, the mesh of that call is used and ``mesh`` is ignored.
            mesh: vertices [m] in the frame of the mesh.
        """
        if key in self._meshes:
            return self._meshes[key]
        first = len(self._levels)
        material = self._own_materials(mesh)
        for level in mesh_levels(mesh):
            self._coarser.append(len(self._levels) + 1)
            self._levels.append(level)
            self._face_materials.append(material[level.source])
        # The coarsest level has no next one.
        self._coarser[-1] = -1
        return self._meshes.setdefault(key, first)

    def _own_materials(self, mesh: Mesh) -> np.ndarray:
        """Add the materials of a mesh's colours and textures; returns the id (F,) i32 per face, else `PLAIN_FACE`."""
        count = len(mesh.faces)
        if mesh.face_color is None and not mesh.textures:
            return np.full(count, PLAIN_FACE, np.int32)
        color = (
            np.ones((count, 3))
            if mesh.face_color is None
            # Rounded: scans have thousands of colours that nobody tells apart, and each is a material.
            else np.round(mesh.face_color, 2)
        )
        number = np.full(count, -1) if mesh.face_texture is None else mesh.face_texture
        looks, index = np.unique(np.c_[color, number], axis=0, return_inverse=True)
        ids = [
            self.add_material(
                Material((float(r), float(g), float(b)), gloss=MESH_GLOSS),
                _pick(mesh.textures, int(k)),
            )
            for r, g, b, k in looks
        ]
        return np.array(ids, np.int32)[index.reshape(-1)]

    def add_geom_mesh(
        self, geom: Geom, meshes: Mapping[str, object] | None = None
    ) -> tuple[int, Vec3]:
        """Add the mesh of a geom; boxes, cylinders and spheres of all sizes share one unit mesh each.

        Args:
            geom: of any shape; its pose is ignored.
            meshes: meshes by name, for geoms of shape "mesh".

        Returns:
            Mesh id, and the scale (3,) that gives the mesh the size of the geom.

        Raises:
            UsageError: ``meshes`` lacks the geom's mesh.
        """
        a, b, c = geom.size
        if geom.shape == "mesh":
            found = (meshes or {}).get(geom.mesh)
            if not isinstance(found, Mesh):
                raise unknown_name("mesh", geom.mesh, meshes or {})
            # A capsule cannot be a scaled unit one, as its ends would not stay round: one mesh for each proportion.
            return self.add_mesh(("mesh", geom.mesh), found), geom.size
        if geom.shape == "capsule":
            return self.add_mesh(
                ("capsule", round(b / a, 3)), capsule_mesh(1.0, b / a)
            ), (a, a, a)
        unit = Geom(geom.shape, UNIT)
        return self.add_mesh(geom.shape, primitive_mesh(unit)), {
            "box": (a, b, c),
            "cylinder": (a, a, b),
        }.get(geom.shape, (a, a, a))

    def add_body_instance(
        self,
        mesh: int,
        body_id: int,
        pose: tuple[ArrayLike, ArrayLike] = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
        material: int = -1,
        seg: str = "background",
        scale: ArrayLike = UNIT,
    ) -> int:
        """Attach a mesh to a body of the model; returns the instance id.

        Args:
            mesh: id from `add_mesh`.
            body_id: id of the body in the MjModel, above 0.
            pose: position (3,) [m] and quaternion (4,) wxyz in the body's frame.
            material: id, or -1 for the materials of the mesh.
            seg: name in segmentation images.
            scale: (3,) along the axes of the instance.

        Raises:
            UsageError: ``body_id`` is 0 or less, or ``mesh`` is not an id of this builder.
        """
        check(
            body_id > 0,
            "body_id",
            body_id,
            "above 0 (the world)",
            where="add_body_instance",
        )
        pos, quat = pose
        self._local.append(
            (np.asarray(pos, float), mat_from_quat(np.asarray(quat, float)))
        )
        return self._add(
            mesh, body_id, seg, _HomeLook(np.zeros(3), np.eye(3), scale, material)
        )

    def add_world_instance(
        self,
        mesh: int,
        pos: ArrayLike,
        quat: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        scale: ArrayLike = UNIT,
        material: ArrayLike = -1,
        seg: str = "background",
    ) -> int:
        """Place a static mesh in the world, with a pose, scale and material per home; returns the instance id.

        Args:
            mesh: id from `add_mesh`.
            pos, quat, scale: (H, 3) [m], (H, 4) wxyz, (H, 3), or one value for all homes; scale 0 hides it.
            material: (H,) ids or one id; -1 for the materials of the mesh.
            seg: name in segmentation images.

        Raises:
            UsageError: ``mesh`` is not an id of this builder.
        """
        self._local.append((np.zeros(3), np.eye(3)))
        mat = mat_from_quat(np.asarray(quat, float))
        return self._add(mesh, 0, seg, _HomeLook(pos, mat, scale, material))

    def _add(self, mesh: int, body: int, seg: str, look: _HomeLook) -> int:
        check_between("mesh id", mesh, 0, len(self._levels) - 1)
        h = self.num_homes
        self._home_pose.append(
            (
                np.broadcast_to(np.asarray(look.pos, float), (h, 3)),
                np.broadcast_to(np.asarray(look.mat, float), (h, 3, 3)),
                np.broadcast_to(np.asarray(look.scale, float), (h, 3)),
            )
        )
        self._home_material.append(
            np.broadcast_to(np.asarray(look.material, np.int32), (h,))
        )
        self._instances.append((mesh, body, self.segment(seg)))
        return len(self._instances) - 1

    def add_body_geom(
        self,
        geom: Geom,
        body_id: int,
        seg: str = "background",
        meshes: Mapping[str, object] | None = None,
    ) -> int:
        """Attach a geom to a body; returns the instance id.

        Its named material is used unless its mesh has colours or textures of its own.

        Args:
            geom: its pose is in the body's frame.
            body_id: id of the body in the MjModel, above 0.
            seg: name in segmentation images.
            meshes: meshes by name.

        Raises:
            UsageError: the material, the mesh or the body is not valid.
        """
        mesh, scale = self.add_geom_mesh(geom, meshes)
        # -1 lets the faces keep the materials of the mesh.
        material = -1 if self._colored(mesh) else self.material(geom.material)
        return self.add_body_instance(
            mesh, body_id, (geom.pos, geom.quat), material, seg, scale
        )

    def add_world_geom(
        self,
        geom: Geom,
        pos: ArrayLike = (0.0, 0.0, 0.0),
        quat: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        seg: str = "background",
        present: ArrayLike = True,
        meshes: Mapping[str, object] | None = None,
    ) -> int:
        """Place a geom of a piece of furniture in the world; returns the instance id.

        Args:
            geom: its pose is relative to the frame of the piece.
            pos, quat: world pose of that frame per home, (H, 3) [m] and (H, 4) wxyz.
            seg: name in segmentation images.
            present: (H,) bool, homes that have the piece.
            meshes: meshes by name.

        Raises:
            UsageError: the material or the mesh is unknown.
        """
        mesh, scale = self.add_geom_mesh(geom, meshes)
        material = -1 if self._colored(mesh) else self.material(geom.material)
        frame = mat_from_quat(np.asarray(quat, float))
        where = np.asarray(pos, float) + np.einsum(
            "...rc,c->...r", frame, np.asarray(geom.pos, float)
        )
        # A scale of 0 hides the piece in homes that lack it: all homes share their instances.
        shown = np.asarray(present, float)[..., None] * np.asarray(scale, float)
        self._local.append((np.zeros(3), np.eye(3)))
        mat = frame @ mat_from_quat(np.asarray(geom.quat))
        return self._add(mesh, 0, seg, _HomeLook(where, mat, shown, material))

    def _colored(self, mesh: int) -> bool:
        """Whether the mesh has colours or textures of its own."""
        return bool((self._face_materials[mesh] != PLAIN_FACE).any())

    def add_light(self, home: int, light: Light) -> None:
        """Add a point light to the home with this index."""
        self._lights[home].append(light)

    def build(self) -> RenderScene:
        """Return the arrays of the scene.

        Raises:
            UsageError: no instance was added.
        """
        if not self._instances:
            raise UsageError(
                "SceneBuilder.build: nothing was added; add an instance first."
            )
        mesh, body, seg = (
            np.array(column, np.int32) for column in zip(*self._instances, strict=True)
        )
        pos, mat, scale = (
            np.ascontiguousarray(np.stack(part, 1))
            for part in zip(*self._home_pose, strict=True)
        )
        return RenderScene(
            **self._mesh_arrays(),
            instance_mesh=mesh,
            instance_body=body,
            instance_pos=np.stack([p for p, _ in self._local]),
            instance_mat=np.stack([m for _, m in self._local]),
            instance_seg=seg,
            instance_material=np.ascontiguousarray(np.stack(self._home_material, 1)),
            home_pos=pos,
            home_mat=mat,
            home_scale=scale,
            seg_names=tuple(self._segments),
            texels=self._textures.build(),
            **self._look_arrays(),
            **self._light_arrays(),
        )

    def _mesh_arrays(self) -> dict[str, np.ndarray]:
        levels = self._levels
        counts = np.array([len(level.vertices) for level in levels])
        faces = np.array([len(level.faces) for level in levels], np.int32)
        return {
            "vertices": np.concatenate([level.vertices for level in levels]),
            "faces": (
                np.concatenate([level.faces for level in levels])
                + np.repeat(np.cumsum(counts) - counts, faces)[:, None]
            ).astype(np.int32),
            "face_material": np.concatenate(self._face_materials),
            "face_normal": np.concatenate([level.normal for level in levels]),
            "face_uv": np.concatenate([level.uv for level in levels]),
            "face_density": np.concatenate([level.density for level in levels]),
            "mesh_face_start": (np.cumsum(faces) - faces).astype(np.int32),
            "mesh_face_count": faces,
            "mesh_coarser": np.array(self._coarser, np.int32),
            "mesh_error": np.concatenate([level.error for level in levels]),
        }

    def _look_arrays(self) -> dict[str, np.ndarray]:
        looks = [material for material, _ in self._materials]
        # Patterns need two colours; a darker shade of the first goes with everything.
        second = [m.color2 or tuple(0.72 * c for c in m.color) for m in looks]
        pattern = np.array([m.pattern != "plain" for m in looks])
        return {
            "mat_color": srgb_to_linear([m.color for m in looks]),
            "mat_color2": srgb_to_linear(second),
            "mat_texture": np.array(
                [texture for _, texture in self._materials], np.int32
            ),
            "mat_pattern": pattern,
            "mat_size": np.array(
                [np.multiply(m.scale, PERIODS.get(m.pattern, (1.0, 1.0))) for m in looks]
            ),
            "mat_gloss": np.array([m.gloss for m in looks]),
            "mat_kind": np.array([m.kind for m in looks]),
        }

    def _light_arrays(self) -> dict[str, np.ndarray]:
        """Lamps of all homes; unused slots have zero colour."""
        # At least one slot, because kernels take no empty arrays.
        most = max(1, *(len(lights) for lights in self._lights))
        pos = np.zeros((self.num_homes, most, 3))
        color = np.zeros((self.num_homes, most, 3))
        for home, lights in enumerate(self._lights):
            for k, light in enumerate(lights):
                pos[home, k] = light.pos
                color[home, k] = np.asarray(light.color) * light.intensity
        return {"light_pos": pos, "light_color": color}
