"""Textured meshes as meshes with one colour per face, for a renderer without textures.

Faces are cut where their texture varies most, so that a rug of two triangles keeps its pattern.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mjhab.scenes.gltf import Primitive
from mjhab.scenes.meshes import Mesh

Array = np.ndarray
MIN_EDGE = 0.012
"""Edges shorter than this [m] are not cut."""
PLAIN = 0.012
"""Spread of the colours (standard deviation, 0..1) up to which a face counts as of one colour."""
COLOR_STEP = 1 / 48
"""Colours are rounded to this, which bounds the number of materials."""
_GRID = np.array([(i, j, 5 - i - j) for i in range(6) for j in range(6 - i)], float)
_SPOTS = (_GRID + 1 / 3) / 6
"""Barycentric coordinates (21, 3) of the spots of a face at which its texture is read."""


def painted_mesh(parts: Sequence[Primitive], max_faces: int) -> Mesh:
    """Bring textured parts into one mesh with a colour per face.

    Args:
        parts: as read from one or more files, vertices in the wanted frame.
        max_faces: faces are cut as long as there are fewer than this many.

    Returns:
        The mesh; faces that can be seen from behind are there twice, once for each side.
    """
    vertices, faces, colors = [], [], []
    area = np.array([_areas(p.vertices, p.faces).sum() for p in parts])
    start = 0
    for part, share in zip(parts, area / max(area.sum(), 1e-12), strict=True):
        points, uv, triangles = part.vertices, part.uv, part.faces.astype(np.int64)
        color = _colors(part, uv, triangles)
        if part.texture is not None:
            points, uv, triangles, color = _refine(part, points, triangles, int(share * max_faces))
        mean = color.mean(axis=1)
        back = _open_faces(points, triangles)
        triangles = np.concatenate([triangles, triangles[back][:, ::-1]])
        vertices.append(points)
        faces.append(triangles + start)
        colors.append(np.concatenate([mean, mean[back]]))
        start += len(points)
    color = np.round(np.concatenate(colors) / COLOR_STEP) * COLOR_STEP
    return Mesh(
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        np.clip(color, 0.0, 1.0).astype(np.float32),
    )


def _colors(part: Primitive, uv: Array | None, faces: Array) -> Array:
    """Colours (F, spots, 3) sRGB 0..1 at the spots of faces."""
    if part.texture is None or uv is None:
        return np.broadcast_to(_srgb(part.color), (len(faces), len(_SPOTS), 3))
    height, width = part.texture.shape[:2]
    where = np.einsum("sk,fkc->fsc", _SPOTS, uv[faces]) % 1.0
    column = np.minimum((where[..., 0] * width).astype(int), width - 1)
    row = np.minimum((where[..., 1] * height).astype(int), height - 1)
    seen = part.texture[row, column] / 255.0
    if np.allclose(part.color, 1.0):
        return seen
    return _srgb(np.where(seen <= 0.04045, seen / 12.92, ((seen + 0.055) / 1.055) ** 2.4) * part.color)


def _srgb(linear: Array) -> Array:
    linear = np.clip(np.asarray(linear, float), 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _areas(vertices: Array, faces: Array) -> Array:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def _weld(vertices: Array) -> Array:
    """(V,) number of the place of every vertex; split seams share places."""
    return np.unique(np.round(vertices, 5), axis=0, return_inverse=True)[1].reshape(-1)


def _edge_keys(faces: Array, weld: Array) -> Array:
    """(F, 3) number of the edge from corner k to corner k + 1; the same from both of its faces."""
    ends = np.sort(np.stack([weld[faces], weld[np.roll(faces, -1, axis=1)]], axis=-1), axis=-1)
    keys = ends[..., 0] * (int(weld.max()) + 1) + ends[..., 1]
    return np.unique(keys, return_inverse=True)[1].reshape(-1, 3)


def _refine(part: Primitive, points: Array, faces: Array, budget: int) -> tuple[Array, Array, Array, Array]:
    """Cut edges, on both of their sides, until the budget is used or every face is of one colour."""
    assert part.uv is not None
    uv = part.uv
    color = _colors(part, uv, faces)
    while len(faces) < budget:
        cut = _edges_to_cut(points, faces, color, budget - len(faces))
        if not len(cut):
            break
        face, corner = cut[:, 0], cut[:, 1]
        a, b, c = (faces[face, (corner + k) % 3] for k in range(3))
        middle = len(points) + np.arange(len(cut))
        points = np.concatenate([points, (points[a] + points[b]) / 2])
        uv = np.concatenate([uv, (uv[a] + uv[b]) / 2])
        new = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
        keep = np.ones(len(faces), bool)
        keep[face] = False
        faces = np.concatenate([faces[keep], new])
        color = np.concatenate([color[keep], _colors(part, uv, new)])
    return points, uv, faces, color


def _edges_to_cut(points: Array, faces: Array, color: Array, room: int) -> Array:
    """Rows (face, corner): the longest edges of the most varied faces, each with all faces that share it, and no face
    twice."""
    spread = color.std(axis=1).max(axis=1)
    edge = points[np.roll(faces, -1, axis=1)] - points[faces]
    length = np.linalg.norm(edge, axis=2)
    score = np.where((spread > PLAIN) & (length.max(axis=1) > MIN_EDGE), spread * _areas(points, faces), 0.0)
    keys = _edge_keys(faces, _weld(points))
    order = np.argsort(keys.ravel(), kind="stable")
    bounds = np.searchsorted(keys.ravel()[order], np.arange(int(keys.max()) + 2))
    used = np.zeros(len(faces), bool)
    rows: list[tuple[int, int]] = []
    most = min(room, max(32, len(faces)))
    for face in np.argsort(-score, kind="stable"):
        if score[face] <= 0.0 or len(rows) >= most:
            break
        if used[face]:
            continue
        key = keys[face, int(length[face].argmax())]
        shared = order[bounds[key] : bounds[key + 1]]
        if used[shared // 3].any() or len(np.unique(shared // 3)) < len(shared):
            continue
        used[shared // 3] = True
        rows += [(int(s) // 3, int(s) % 3) for s in shared]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def _open_faces(points: Array, faces: Array) -> Array:
    """Faces (n,) of pieces with a rim: sheets, whose back can be seen."""
    keys = _edge_keys(faces, _weld(points))
    number = np.repeat(np.arange(len(faces)), 3)
    order = np.argsort(keys.ravel(), kind="stable")
    key, owner = keys.ravel()[order], number[order]
    same = key[1:] == key[:-1]
    links = coo_matrix((np.ones(same.sum()), (owner[1:][same], owner[:-1][same])), shape=(len(faces),) * 2)
    piece = connected_components(links, directed=False)[1]
    rim = np.bincount(keys.ravel())[keys] == 1
    open_pieces = np.unique(piece[rim.any(axis=1)])
    return np.flatnonzero(np.isin(piece, open_pieces))
