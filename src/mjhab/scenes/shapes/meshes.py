"""Triangle meshes of the render scene and of convex collision pieces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

_OPTIONAL = ("face_color", "uv", "face_texture")


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) float32 [m].
        faces: (F, 3) int32, counter-clockwise seen from outside.
        face_color: (F, 3) float32 sRGB in 0..1, multiplied with the texture; None takes the geom's material.
        uv: (F, 3, 2) float32 texture coordinates of every face corner: (0, 0) at the outer corner of the first texel,
            (1, 1) at that of the last one, u along rows; textures repeat. None without textures.
        face_texture: (F,) int32, index into ``textures``, -1 for none. None without textures.
        textures: images (h, w, 3) uint8 sRGB with sides that are powers of two up to `gltf.MAX_TEXTURE`.
    """

    vertices: np.ndarray
    faces: np.ndarray
    face_color: np.ndarray | None = None
    uv: np.ndarray | None = None
    face_texture: np.ndarray | None = None
    textures: tuple[np.ndarray, ...] = ()


def mesh_arrays(name: str, mesh: Mesh) -> dict[str, np.ndarray]:
    """Return the arrays of a mesh under keys ``<name>/...``, for an npz file."""
    arrays = {f"{name}/vertices": mesh.vertices, f"{name}/faces": mesh.faces}
    for part in _OPTIONAL:
        value = getattr(mesh, part)
        if value is not None:
            arrays[f"{name}/{part}"] = value
    return arrays | {f"{name}/texture{k}": image for k, image in enumerate(mesh.textures)}


def mesh_from_arrays(name: str, arrays: Mapping[str, np.ndarray]) -> Mesh:
    """Make a mesh from arrays with the keys of `mesh_arrays`.

    Raises:
        KeyError: vertices or faces of the mesh are missing.
    """
    optional = {
        part: arrays[f"{name}/{part}"] for part in _OPTIONAL if f"{name}/{part}" in arrays
    }
    textures: list[np.ndarray] = []
    # Their number is nowhere in the file.
    while (key := f"{name}/texture{len(textures)}") in arrays:
        textures.append(arrays[key])
    return Mesh(
        arrays[f"{name}/vertices"],
        arrays[f"{name}/faces"],
        **optional,
        textures=tuple(textures),
    )
