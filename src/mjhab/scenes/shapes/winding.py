"""Which side of a face is outside: closed surfaces are turned outwards, whatever the winding of the file.

Files are wound inwards, mirrored by a negative scale, or wound at random where their material is double-sided.
Renderers draw the front of a face only, so that a surface wound inwards shows its inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

FLAT_SHARE = 1e-6
"""A closed piece that encloses less than this share of the volume of its bounding cube has no inside."""
WELD_DIGITS = 5
"""Vertices that are equal to this many digits of the size of the mesh count as one: texture seams split vertices."""


@dataclass(frozen=True, eq=False)
class Winding:
    """How the F faces of a mesh are wound. A piece is a set of faces that are linked by edges of two faces each.

    Attributes:
        flipped: (F,) bool, faces of closed pieces whose corners must be reversed to be counter-clockwise seen from
            outside.
        sheet: (F,) bool, faces whose back can be seen: those of pieces that are open, that have no two sides, or that
            enclose no volume.
    """

    flipped: np.ndarray
    sheet: np.ndarray


def find_winding(points: np.ndarray, faces: np.ndarray) -> Winding:
    """Find the faces of a mesh that are wound inwards, and those that are seen from both sides.

    A face whose other side is in the mesh as a face of its own is left as it is, and is no sheet.

    Args:
        points: (V, 3).
        faces: (F, 3) indices.
    """
    flipped = np.zeros(len(faces), bool)
    sheet = np.zeros(len(faces), bool)
    rows = np.flatnonzero(_single(points, faces))
    if len(rows):
        corners = _welded(points)[faces[rows]]
        piece, turned, closed = _pieces(corners)
        # A closed surface wound inwards encloses a negative volume.
        volume, least = _volumes(points[faces[rows]], piece, turned)
        solid = closed & (np.abs(volume) > least)
        flipped[rows] = solid[piece] & (turned ^ (volume < 0.0)[piece])
        sheet[rows] = ~solid[piece]
    return Winding(flipped, sheet)


def turned_outwards(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, Winding]:
    """Turn the closed pieces of a mesh outwards.

    Args:
        points: (V, 3).
        faces: (F, 3) indices.

    Returns:
        The faces, with the corners of some in reversed order, and which those are.
    """
    winding = find_winding(points, faces)
    return reversed_where(winding.flipped, faces), winding


def reversed_where(flipped: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Reverse the corners of the ``flipped`` (F,) faces in an array (F, 3, ...) of values per corner."""
    if not flipped.any():
        return corners
    out = corners.copy()
    out[flipped] = corners[flipped][:, ::-1]
    return out


def _welded(points: np.ndarray) -> np.ndarray:
    """Number (V,) of the place of every vertex; vertices at the same place have the same number."""
    # A mesh of one point has no size.
    size = max(float(np.ptp(points, axis=0).max(initial=0.0)), 1e-12)
    grid = np.round((points - points.min(axis=0)) / size, WELD_DIGITS)
    return np.unique(grid, axis=0, return_inverse=True)[1].reshape(-1)


def _single(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) bool: faces with an area that are in the mesh once, in either winding."""
    if not len(faces):
        return np.zeros(0, bool)
    corners = np.sort(_welded(points)[faces], axis=1)
    whole = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2])
    _, index, count = np.unique(corners, axis=0, return_inverse=True, return_counts=True)
    return whole & (count[index.reshape(-1)] == 1)


def _pieces(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pieces of faces (F, 3) of welded vertices.

    Returns:
        The piece (F,) of every face; whether the face must be reversed to be wound as the first face of its piece (F,)
        bool; and for each of the P pieces whether it is closed and has two sides (P,) bool.
    """
    count = len(corners)
    start = corners.reshape(-1)
    end = np.roll(corners, -1, axis=1).reshape(-1)
    owner = np.repeat(np.arange(count), 3)
    many = int(corners.max()) + 1
    key = np.minimum(start, end) * many + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    key, index, size = np.unique(key[order], return_index=True, return_counts=True)
    one = order[index[size == 2]]
    other = order[index[size == 2] + 1]
    # Two faces are wound alike if they pass their common edge in opposite directions. In the graph of faces and
    # reversed faces (F later ones), an edge links what is wound alike.
    against = (start[one] == start[other]).astype(np.int64) * count
    a = np.concatenate([owner[one], owner[one] + count])
    b = np.concatenate(
        [owner[other] + against, (owner[other] + against + count) % (2 * count)]
    )
    label = connected_components(
        coo_matrix((np.ones(len(a), bool), (a, b)), shape=(2 * count, 2 * count)),
        directed=False,
    )[1]
    # Each piece appears twice, as it is and reversed: the smaller label names both.
    low = np.minimum(label[:count], label[count:])
    first, piece = np.unique(low, return_inverse=True)
    piece = piece.reshape(-1)
    two_sided = np.ones(len(first), bool)
    # A face linked with its own reverse lies on a Moebius strip, which has no outside.
    two_sided[piece[label[:count] == label[count:]]] = False
    return piece, label[:count] != low, two_sided & _closed(owner, order, size, piece)


def _closed(
    owner: np.ndarray, order: np.ndarray, size: np.ndarray, piece: np.ndarray
) -> np.ndarray:
    """(P,) bool: pieces in which every edge has two faces.

    Solids that touch in an edge are pieces of their own, with two of its four faces each.

    Args:
        owner: (3 F,) face of every side of a face.
        order: (3 F,) sides sorted by edge.
        size: (E,) number of sides of every edge.
        piece: (F,) piece of every face.
    """
    edge = np.repeat(np.arange(len(size)), size)
    of = piece[owner[order]]
    pieces = int(piece.max()) + 1
    key, count = np.unique(edge * pieces + of, return_counts=True)
    closed = np.ones(pieces, bool)
    closed[(key % pieces)[count != 2]] = False
    return closed


def _volumes(
    corners: np.ndarray, piece: np.ndarray, turned: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Signed volume (P,) of every piece, wound as its first face, and the least (P,) that counts as a volume.

    ``corners`` (F, 3, 3) of faces; ``piece`` and ``turned`` (F,): see `_pieces`.
    """
    pieces = int(piece.max()) + 1
    low = np.full((pieces, 3), np.inf)
    high = np.full((pieces, 3), -np.inf)
    for k in range(3):
        np.minimum.at(low, piece, corners[:, k])
        np.maximum.at(high, piece, corners[:, k])
    # Relative to a point of the piece, for numerical precision.
    a, b, c = np.moveaxis(corners - low[piece][:, None], 1, 0)
    part = np.einsum("fk,fk->f", a, np.cross(b, c)) / 6.0
    volume = np.bincount(piece, np.where(turned, -part, part), pieces)
    return volume, FLAT_SHARE * (high - low).max(axis=1) ** 3
