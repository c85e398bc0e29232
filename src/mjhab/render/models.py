"""Textured triangle meshes of a home, for the browser and the path tracer, made from a `RenderScene`.

All static instances become one model in the world frame. The instances of a body become one model in the frame of the
body; bodies that look alike share it.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mjhab.render.patterns import SHADE_TOP
from mjhab.render.render_scene import RenderScene
from mjhab.scenes.shapes.colors import linear_to_srgb

MAX_TEXTURE_SIDE = 256
"""Longest side of a texture in the browser [px]."""
_NO_TEXTURE = -1


@dataclass(frozen=True, eq=False)
class Look:
    """A material. color: (3,) linear rgb, multiplied with the texture. gloss: 0 to 1.

    texture: (h, w, 3) uint8 sRGB that repeats in both directions, or None. kind: as `Material.kind`.
    """

    color: np.ndarray
    gloss: float
    texture: np.ndarray | None
    kind: str = ""


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material. V vertices, F faces.

    look: index into `DrawnHome.looks`. vertices (V, 3) f32 [m], normals (V, 3) f32, unit, in the frame of the body or
    the world; uv (V, 2) f32: texture coordinates, v = 0 at row 0 of the image; faces (F, 3) i32.
    """

    look: int
    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True, eq=False)
class Model:
    """The meshes of one or more bodies that look alike. bodies: their ids in the `MjModel`; (0,) is the world."""

    bodies: tuple[int, ...]
    parts: tuple[Part, ...]


@dataclass(frozen=True, eq=False)
class DrawnHome:
    """Everything visible in one home.

    home: the static model. movable: models of bodies. looks: the materials. lamp_pos (L, 3) [m], lamp_color (L, 3)
    linear rgb times intensity.
    """

    home: Model
    movable: tuple[Model, ...]
    looks: tuple[Look, ...]
    lamp_pos: np.ndarray
    lamp_color: np.ndarray


def home_models(
    scene: RenderScene,
    home: int,
    max_faces: int | None = None,
    max_side: int = MAX_TEXTURE_SIDE,
) -> DrawnHome:
    """Compute the models of one home from a render scene.

    Args:
        scene: of the layout.
        home: index of the home in the scene.
        max_faces: use the finest level of detail with at most this number of faces, or the coarsest there is; None uses
            the finest.
        max_side: longest side of a texture [px].
    """
    if max_faces is not None:
        scene = _coarser(scene, max_faces)
    # What a home lacks has scale 0.
    shown = np.flatnonzero((scene.home_scale[home] != 0.0).all(axis=1))
    by_body: dict[int, list[int]] = defaultdict(list)
    for instance in shown.tolist():
        by_body[int(scene.instance_body[instance])].append(instance)
    looks = _Looks(scene, max_side)
    still = Model((0,), _parts(scene, home, by_body.pop(0, []), looks))
    alike: dict[bytes, list[int]] = defaultdict(list)
    for body, instances in sorted(by_body.items()):
        alike[_shape_key(scene, home, instances)].append(body)
    movable = tuple(
        Model(tuple(bodies), _parts(scene, home, by_body[bodies[0]], looks))
        for bodies in alike.values()
    )
    lit = scene.light_color[home].any(axis=1)
    return DrawnHome(
        still,
        movable,
        tuple(looks.found),
        scene.light_pos[home, lit],
        scene.light_color[home, lit],
    )


def _coarser(scene: RenderScene, max_faces: int) -> RenderScene:
    """The scene with every instance at its finest level of at most ``max_faces`` faces, or at its coarsest."""
    mesh = scene.instance_mesh.copy()
    while True:
        more = (scene.mesh_face_count[mesh] > max_faces) & (scene.mesh_coarser[mesh] >= 0)
        if not more.any():
            return dataclasses.replace(scene, instance_mesh=mesh)
        mesh[more] = scene.mesh_coarser[mesh[more]]


def _shape_key(scene: RenderScene, home: int, instances: list[int]) -> bytes:
    """Key of the look of a body with these instances; equal for bodies that look alike."""
    columns = (
        scene.instance_mesh[instances],
        scene.instance_material[home, instances],
        scene.instance_pos[instances],
        scene.instance_mat[instances],
        scene.home_scale[home, instances],
    )
    return b"|".join(np.ascontiguousarray(column).tobytes() for column in columns)


class _Looks:
    """Collect the materials that are used; ``index`` returns the index of a scene's material in ``found``."""

    def __init__(self, scene: RenderScene, max_side: int) -> None:
        self.found: list[Look] = []
        self._scene = scene
        self._max_side = max_side
        self._numbers: dict[int, int] = {}

    def index(self, material: int) -> int:
        if material not in self._numbers:
            self._numbers[material] = len(self.found)
            self.found.append(self._look(material))
        return self._numbers[material]

    def _look(self, material: int) -> Look:
        scene = self._scene
        gloss = float(scene.mat_gloss[material])
        kind = str(scene.mat_kind[material])
        color = scene.mat_color[material]
        number = int(scene.mat_texture[material])
        if number == _NO_TEXTURE:
            return Look(color, gloss, None, kind)
        picture = _picture(scene, number, self._max_side)
        if not scene.mat_pattern[material]:
            return Look(color, gloss, picture, kind)
        # Browsers know no patterns: the two colours are mixed here.
        mix = picture[..., :1] / 255.0
        shade = picture[..., 1:2] * (SHADE_TOP / 255.0)
        light = shade * (color + mix * (scene.mat_color2[material] - color))
        # The colour is in the picture already.
        return Look(np.ones(3), gloss, srgb_bytes(light), kind)


def _picture(scene: RenderScene, number: int, max_side: int) -> np.ndarray:
    """The finest mip level (h, w, 3) uint8 of a texture with sides up to ``max_side``."""
    bits = scene.texels.bits[number]
    # Mip levels are there anyway, and are averaged in linear light.
    level = max(0, int(bits.max()) - (max_side.bit_length() - 1))
    wide = 1 << max(0, int(bits[0]) - level)
    high = 1 << max(0, int(bits[1]) - level)
    start = int(scene.texels.start[number, level])
    words = scene.texels.pixels[start : start + wide * high].reshape(high, wide)
    return np.stack([(words >> shift) & 255 for shift in (0, 8, 16)], axis=-1).astype(
        np.uint8
    )


def srgb_bytes(light: np.ndarray) -> np.ndarray:
    """Convert linear light 0 to 1 (any shape, clipped) to sRGB uint8."""
    return np.round(255.0 * linear_to_srgb(light)).astype(np.uint8)


def _parts(
    scene: RenderScene, home: int, instances: Iterable[int], looks: _Looks
) -> tuple[Part, ...]:
    corners: dict[int, list[np.ndarray]] = defaultdict(list)
    for instance in instances:
        for material, rows in _corners(scene, home, instance):
            corners[looks.index(material)].append(rows)
    return tuple(
        _joined(look, np.concatenate(rows)) for look, rows in sorted(corners.items())
    )


def _corners(
    scene: RenderScene, home: int, instance: int
) -> list[tuple[int, np.ndarray]]:
    """Corners (3 F, 8) of the faces of an instance by material: position [m], unit normal, texture coordinates."""
    mesh = scene.instance_mesh[instance]
    start = int(scene.mesh_face_start[mesh])
    faces = np.arange(start, start + int(scene.mesh_face_count[mesh]))
    points = scene.vertices[scene.faces[faces]].astype(np.float64)
    scale = scene.home_scale[home, instance]
    normals = (
        # Normals are divided by the scale where points are multiplied.
        np.einsum("fij,fkj->fki", scene.face_normal[faces], _with_one(points)) / scale
    )
    normals = _unit(normals)
    given = scene.instance_material[home, instance]
    material = scene.face_material[faces] if given < 0 else np.full(len(faces), given)
    uv = np.einsum("fij,fkj->fki", scene.face_uv[faces], _with_one(points))
    sized = points * scale
    on_pattern = scene.mat_pattern[material]
    uv[on_pattern] = _pattern_uv(scene, instance, sized, normals, material)[on_pattern]
    if scene.instance_body[instance] == 0:
        turn = scene.home_mat[home, instance]
        offset = scene.home_pos[home, instance]
    else:
        turn = scene.instance_mat[instance]
        offset = scene.instance_pos[instance]
    # Files have quaternions with few digits, so that their rotation matrices are not quite orthonormal.
    turned = _unit(normals @ turn.T)
    rows = np.concatenate([sized @ turn.T + offset, turned, uv], axis=2)
    if scale.prod() < 0.0:
        # A mirrored face has its corners in the opposite order; browsers do not draw the back of a face.
        rows = rows[:, ::-1]
    found = np.unique(material)
    return [(int(k), rows[material == k].reshape(-1, 8)) for k in found.tolist()]


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _with_one(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)


def _pattern_uv(
    scene: RenderScene,
    instance: int,
    sized: np.ndarray,
    normals: np.ndarray,
    material: np.ndarray,
) -> np.ndarray:
    """Texture coordinates (F, 3, 2) of face corners in a pattern, projected as in `raster.texturing`.

    ``sized`` (F, 3, 3) [m], ``normals`` (F, 3, 3): corners and their normals in the frame of the instance; ``material``
    (F,).
    """
    extent = np.ptp(sized.reshape(-1, 3), axis=0)
    across = np.abs(normals.mean(axis=1)).argmax(axis=1)
    axes = np.array([(1, 2), (0, 2), (0, 1)])[across]
    swap = extent[axes[:, 0]] < extent[axes[:, 1]]
    axes[swap] = axes[swap][:, ::-1]
    place = np.take_along_axis(sized, axes[:, None, :].repeat(3, axis=1), axis=2)
    # Every instance has another offset in the pattern.
    start = np.array([0.37, 0.23]) * instance % 1.0
    return place / scene.mat_size[material][:, None, :] + start


def _joined(look: int, corners: np.ndarray) -> Part:
    """A part from corners (3 F, 8), merging equal corners into one vertex."""
    # Rounded, so that equal corners are equal bytes; adding 0 makes -0.0 a 0.0.
    rows = np.ascontiguousarray(np.round(corners, 5), np.float32) + np.float32(0.0)
    _, first, index = np.unique(
        rows.view(f"V{rows.shape[1] * 4}").reshape(-1),
        return_index=True,
        return_inverse=True,
    )
    kept = rows[first]
    return Part(
        look,
        kept[:, :3],
        kept[:, 3:6],
        kept[:, 6:],
        index.reshape(-1, 3).astype(np.int32),
    )
