"""Mesh simplification by edge collapse with error quadrics, for levels of detail.

Quadrics as in Garland and Heckbert, Surface Simplification Using Quadric Error Metrics, 1997. In every round all edges
are collapsed that cost less than all edges near them, so that a round consists of a few array operations.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjhab.scenes.shapes.simplify import Simplified

MAX_ROUNDS = 400
ROUND_SHARE = 0.25
"""Only the cheapest edges collapse in a round; their fraction of all edges."""
BORDER_WEIGHT = 10.0
"""Weight of the planes through border edges, perpendicular to their face, relative to a face of the same size."""
STIFFNESS = 1e-4
"""Weight that pulls a merged vertex to the middle of its edge in directions that the planes do not determine."""
MAX_TRIES = 20
"""Number of times that a round chooses other edges if all chosen ones would flip a face."""
MIN_TURN_COS = 0.3
"""Smallest cosine of the angle by which a collapse may turn the normal of a face."""
SLIVER_SHARE = 1e-3
"""Faces with an area below this fraction of their longest side squared may turn, because their normal is undefined."""


def collapse(
    vertices: np.ndarray, faces: np.ndarray, targets: Sequence[int]
) -> list[tuple[Simplified, np.ndarray]]:
    """Collapse edges of a triangle mesh down to a series of face counts.

    Args:
        vertices: (V, 3) without duplicates.
        faces: (F, 3) indices.
        targets: largest numbers of faces, decreasing.

    Returns:
        For every target that can be reached the simplified mesh, and the index (V,) of the vertex that each original
        vertex was merged into, -1 if that has no face.
    """
    mesh = _Mesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int64))
    levels = []
    for target in targets:
        for _ in range(MAX_ROUNDS):
            if len(mesh.faces) <= target or not mesh.shrink(len(mesh.faces) - target):
                break
        if len(mesh.faces) > target:
            break
        levels.append(mesh.compact())
    return levels


class _Mesh:
    """A mesh under simplification.

    place (V, 3): positions of vertices. merged (V,): vertex that each original one was merged into. faces (f, 3):
    remaining faces. source (f,): their index in the original mesh. quadric (V, 4, 4): error quadrics.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.place = vertices.copy()
        self.merged = np.arange(len(vertices))
        # Faces with a corner twice have no normal.
        whole = (faces != np.roll(faces, 1, 1)).all(axis=1)
        self.faces = faces[whole]
        self.source = np.flatnonzero(whole)
        self.quadric = _quadrics(vertices, self.faces)

    def shrink(self, most: int) -> bool:
        """Do a round: collapse edges that share no face, removing about ``most`` faces at most; returns if any did."""
        ends = np.unique(_edges(self.faces), axis=0)
        place, cost = self._merge(ends)
        kept = np.empty(0, np.int64)
        for _ in range(MAX_TRIES):
            # Ties are broken by index, so that results are the same on every machine.
            rank = np.empty(len(ends), np.int64)
            rank[np.argsort(cost, kind="stable")] = np.arange(len(ends))
            free = (rank <= self._cheapest_near(ends, rank)) & np.isfinite(cost)
            chosen = np.flatnonzero(free)
            if not len(chosen):
                return False
            # The cheapest first, because only some of them are kept.
            chosen = chosen[np.argsort(rank[chosen])]
            within = max(ROUND_SHARE * len(ends), rank[chosen[0]])
            chosen = chosen[rank[chosen] <= within][: (most + 1) // 2]
            bad = self._turns(ends[chosen], place[chosen])
            # For the rest of this round: after it, faces around have changed.
            cost[chosen[bad]] = np.inf
            kept = chosen[~bad]
            if len(kept):
                break
        if not len(kept):
            return False
        self._apply(ends[kept], place[kept])
        return True

    def _merge(self, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Best position (e, 3) of the vertex that each edge (e, 2) would collapse to, and its cost (e,)."""
        quadric = self.quadric[ends].sum(axis=1)
        middle = self.place[ends].mean(axis=1)
        weight = np.trace(quadric[:, :3, :3], axis1=1, axis2=2)
        stiff = STIFFNESS * np.maximum(weight, 1e-30)
        matrix = quadric[:, :3, :3] + stiff[:, None, None] * np.eye(3)
        right = -quadric[:, :3, 3] + stiff[:, None] * middle
        place = np.linalg.solve(matrix, right[..., None])[..., 0]
        # Nearly parallel planes may intersect far away: limit the distance to the length of the edge.
        offset = place - middle
        length = np.linalg.norm(self.place[ends[:, 0]] - self.place[ends[:, 1]], axis=1)
        far = np.linalg.norm(offset, axis=1)
        place = (
            middle + offset * np.minimum(1.0, length / np.maximum(far, 1e-30))[:, None]
        )
        point = np.concatenate([place, np.ones((len(ends), 1))], axis=1)
        cost = np.einsum("ei,eij,ej->e", point, quadric, point)
        # On flat surfaces all edges cost nothing: then short ones go first.
        return place, np.maximum(cost, 0.0) + 1e-6 * weight * length**2

    def _cheapest_near(self, ends: np.ndarray, rank: np.ndarray) -> np.ndarray:
        """Lowest rank (e,) of the edges at the vertices of all faces that touch each edge."""
        count = len(self.place)
        at_vertex = np.full(count, len(rank), np.int64)
        # With ``at``, since plain indexing would keep one of several edges at a vertex.
        np.minimum.at(at_vertex, ends.ravel(), np.repeat(rank, 2))
        at_face = at_vertex[self.faces].min(axis=1)
        near = np.full(count, len(rank), np.int64)
        np.minimum.at(near, self.faces.ravel(), np.repeat(at_face, 3))
        return near[ends].min(axis=1)

    def _turns(self, ends: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Whether each collapse (c,) of edges (c, 2) to ``place`` (c, 3) turns a face beyond `MIN_TURN_COS`."""
        owner = np.full(len(self.place), -1)
        owner[ends] = np.arange(len(ends))[:, None]
        moved = self.place.copy()
        moved[ends] = place[:, None]
        touched = (owner[self.faces] >= 0).any(axis=1)
        faces = self.faces[touched]
        # Chosen edges share no face, so that a face has one owner, or -1.
        whose = owner[faces].max(axis=1)
        gone = (owner[faces] == whose[:, None]).sum(axis=1) > 1
        corners = self.place[faces]
        before = _normals(corners)
        side = ((corners - np.roll(corners, 1, 1)) ** 2).sum(axis=2).max(axis=1)
        thin = np.linalg.norm(before, axis=1) < SLIVER_SHARE * side
        after = _normals(moved[faces])
        along = np.einsum("fi,fi->f", before, after)
        size = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        bad = np.zeros(len(ends), bool)
        bad[whose[(along < MIN_TURN_COS * size) & ~gone & ~thin]] = True
        return bad

    def _apply(self, ends: np.ndarray, place: np.ndarray) -> None:
        keep = ends[:, 0]
        drop = ends[:, 1]
        # Vertices keep their numbers; what is no longer used is dropped in the end.
        self.place[keep] = place
        self.quadric[keep] += self.quadric[drop]
        label = np.arange(len(self.place))
        label[drop] = keep
        self.merged = label[self.merged]
        faces = label[self.faces]
        left = (faces != np.roll(faces, 1, 1)).all(axis=1)
        self.faces = faces[left]
        self.source = self.source[left]

    def compact(self) -> tuple[Simplified, np.ndarray]:
        used, index = np.unique(self.faces, return_inverse=True)
        number = np.full(len(self.place), -1)
        number[used] = np.arange(len(used))
        faces = index.reshape(-1, 3)
        return Simplified(self.place[used], faces, self.source.copy()), number[
            self.merged
        ]


def _edges(faces: np.ndarray) -> np.ndarray:
    """Vertices (3 F, 2) of the edges of faces (F, 3), the lower index first."""
    return np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)


def _normals(corners: np.ndarray) -> np.ndarray:
    """Normals (f, 3) of triangles (f, 3, 3); their length is twice the area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _quadrics(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Error quadrics (V, 4, 4): area-weighted squared distances to the planes of the faces at each vertex."""
    corners = vertices[faces]
    normal = _normals(corners)
    area = np.linalg.norm(normal, axis=1)
    unit = normal / np.maximum(area, 1e-30)[:, None]
    result = np.zeros((len(vertices), 4, 4))
    _add_planes(result, faces, unit, corners[:, 0], area)
    ends, first, count = np.unique(
        _edges(faces), axis=0, return_index=True, return_counts=True
    )
    ends = ends[count == 1]
    along = vertices[ends[:, 1]] - vertices[ends[:, 0]]
    upright = np.cross(along, unit[first[count == 1] // 3])
    length = np.linalg.norm(upright, axis=1)
    upright /= np.maximum(length, 1e-30)[:, None]
    _add_planes(result, ends, upright, vertices[ends[:, 0]], BORDER_WEIGHT * length**2)
    return result


def _add_planes(
    quadric: np.ndarray,
    at: np.ndarray,
    unit: np.ndarray,
    point: np.ndarray,
    weight: np.ndarray,
) -> None:
    plane = np.concatenate([unit, -np.einsum("fi,fi->f", unit, point)[:, None]], axis=1)
    outer = weight[:, None, None] * plane[:, :, None] * plane[:, None, :]
    for k in range(at.shape[1]):
        np.add.at(quadric, at[:, k], outer)


def distance_to_faces(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Compute the distance (n,) of each point (n, 3) to the corresponding triangle (n, 3, 3)."""
    a, b, c = (corners[:, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    square = np.einsum("ni,ni->n", normal, normal)
    offset = points - a
    up = np.einsum("ni,ni->n", offset, normal) / np.sqrt(np.maximum(square, 1e-30))
    inside = square > 1e-24
    nearest = np.full(len(points), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        edge = q - p
        to = points - p
        inside &= np.einsum("ni,ni->n", np.cross(edge, to), normal) >= 0.0
        share = np.einsum("ni,ni->n", to, edge) / np.maximum(
            np.einsum("ni,ni->n", edge, edge), 1e-30
        )
        off = to - np.clip(share, 0.0, 1.0)[:, None] * edge
        nearest = np.minimum(nearest, np.linalg.norm(off, axis=1))
    return np.where(inside, np.abs(up), nearest)
