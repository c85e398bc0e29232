"""Triangle meshes of the render scene and of convex collision pieces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

MAX_TEXTURE = 512
"""Longest side of a texture [px]."""
_OPTIONAL = ("face_color", "uv", "face_texture")


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle soup. ``vertices`` (V, 3) [m] float32; ``faces`` (F, 3) int32, counter-clockwise outside.

    ``face_color``: (F, 3) float32 in 0..1 (sRGB) or None, then the material of the geom gives the colour.
    ``textures``: images (h, w, 3) uint8 sRGB, sides powers of two up to `MAX_TEXTURE`, repeated beyond their edges;
    ``face_texture`` (F,) int32: the image of every face, -1 for none; ``uv`` (F, 3, 2) float32: place of every corner
    of every face in it, (0, 0) at the outer corner of the first pixel, (1, 1) at that of the last one (u along rows).
    A texture is multiplied with ``face_color``.
    """

    vertices: np.ndarray
    faces: np.ndarray
    face_color: np.ndarray | None = None
    uv: np.ndarray | None = None
    face_texture: np.ndarray | None = None
    textures: tuple[np.ndarray, ...] = ()


def mesh_arrays(name: str, mesh: Mesh) -> dict[str, np.ndarray]:
    """The arrays of a mesh under names ``<name>/...``, for a npz file."""
    arrays = {f"{name}/vertices": mesh.vertices, f"{name}/faces": mesh.faces}
    for part in _OPTIONAL:
        value = getattr(mesh, part)
        if value is not None:
            arrays[f"{name}/{part}"] = value
    return arrays | {f"{name}/texture{k}": image for k, image in enumerate(mesh.textures)}


def mesh_from_arrays(name: str, arrays: Mapping[str, np.ndarray]) -> Mesh:
    """The mesh that ``mesh_arrays`` took apart.

    Raises:
        KeyError: it is not among the arrays.
    """
    optional = {part: arrays[f"{name}/{part}"] for part in _OPTIONAL if f"{name}/{part}" in arrays}
    textures: list[np.ndarray] = []
    while (key := f"{name}/texture{len(textures)}") in arrays:
        textures.append(arrays[key])
    return Mesh(
        arrays[f"{name}/vertices"], arrays[f"{name}/faces"], **optional, textures=tuple(textures)
    )
