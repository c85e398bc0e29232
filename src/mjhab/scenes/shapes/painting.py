"""Parts of glTF files as one textured mesh: solids turned outwards, sheets on both sides, textures of limited
resolution."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjhab.scenes.formats.gltf import Primitive
from mjhab.scenes.shapes.colors import linear_to_srgb
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.shapes.winding import turned_outwards

TEXELS_PER_M = 1500.0
"""Largest density of texels on a surface [1/m], 0.7 mm each, as fine as the print on a carton."""


def textured_mesh(parts: Sequence[Primitive]) -> Mesh:
    """Combine the parts of one or more files into one mesh.

    Args:
        parts: vertices in the frame of the mesh, textures with sides that are powers of two.

    Returns:
        The mesh. How the parts are wound does not matter: closed surfaces are turned outwards, and faces of open ones,
        whose back is visible, are duplicated with opposite orientation. So a material that is double-sided looks the
        same as one that is not, and a mirrored node the same as its twin.
    """
    columns: list[tuple[np.ndarray, ...]] = []
    images: dict[int, int] = {}
    textures: list[np.ndarray] = []
    start = 0
    for part in parts:
        # Per part: pieces of one material are closed by themselves.
        faces, winding = turned_outwards(part.vertices, part.faces.astype(np.int64))
        uv = np.zeros((len(faces), 3, 2)) if part.uv is None else part.uv[faces]
        number = -1
        if part.texture is not None and part.uv is not None:
            # By identity: parts of one file share their image.
            number = images.setdefault(id(part.texture), len(images))
            if number == len(textures):
                textures.append(fit_texture(part.texture, part.vertices[faces], uv))
        back = np.flatnonzero(winding.sheet)
        # Renderers draw only the front of a face.
        both = np.concatenate([faces, faces[back][:, ::-1]])
        # glTF gives colours as linear light; those of meshes are sRGB.
        color = np.broadcast_to(linear_to_srgb(part.color), (len(both), 3))
        uv = np.concatenate([uv, uv[back][:, ::-1]])
        columns.append(
            (part.vertices, both + start, color, uv, np.full(len(both), number))
        )
        start += len(part.vertices)
    vertices, faces, color, uv, texture = (
        np.concatenate(column) for column in zip(*columns, strict=True)
    )
    plain = Mesh(
        vertices.astype(np.float32), faces.astype(np.int32), color.astype(np.float32)
    )
    if not textures:
        return plain
    return Mesh(
        plain.vertices,
        plain.faces,
        plain.face_color,
        _near_zero(uv).astype(np.float32),
        texture.astype(np.int32),
        tuple(textures),
    )


def fit_texture(image: np.ndarray, corners: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Halve an image until its density on the triangles that show it is at most `TEXELS_PER_M`.

    Args:
        image: (h, w, 3) uint8, sides powers of two.
        corners: (F, 3, 3) of the triangles [m].
        uv: (F, 3, 2) their texture coordinates.
    """
    a = corners[:, 1] - corners[:, 0]
    b = corners[:, 2] - corners[:, 0]
    surface = np.linalg.norm(np.cross(a, b), axis=1).sum() / 2
    p = uv[:, 1] - uv[:, 0]
    q = uv[:, 2] - uv[:, 0]
    covered = np.abs(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum() / 2
    while (
        min(image.shape[:2]) > 8
        and covered * image.shape[0] * image.shape[1] > surface * TEXELS_PER_M**2
    ):
        quads = image.reshape(image.shape[0] // 2, 2, image.shape[1] // 2, 2, 3)
        image = np.round(quads.mean(axis=(1, 3))).astype(np.uint8)
    return image


def _near_zero(uv: np.ndarray) -> np.ndarray:
    """Texture coordinates (F, 3, 2) shifted per face by whole periods towards 0, for the precision of float32."""
    return uv - np.floor(uv.min(axis=1, keepdims=True))
