"""What tells a thing from others that the same words fit: the side on which it is, or what it is nearest to.

Left and right are as seen by somebody who stands before the front of the furniture and faces it; they are said only of
furniture with drawers or doors, whose front can be seen. Nearest is meant in the plan of the floor, between the centre
of the thing and that of a landmark; furniture is nearest both by its centre and by its outline. So no words depend on
where the robot stands, and they stay true while it moves.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

SURE_M = 0.10
"""A difference of distances [m] that words may rest on; a smaller one only where nothing better tells things apart."""
SURE_SIDE_M = 0.08
"""The same for left and right."""
LEAST_M = 0.04
"""The least difference [m] where other words are left to try."""
_NEAREST = ("nearest to",)
_FURTHEST = ("furthest from",)
_BETWEEN = ("", "second nearest to", "third nearest to", "fourth nearest to")


@dataclass(frozen=True, eq=False)
class Landmark:
    """Something of which there is one, and from which distances are told.

    Attributes:
        name: in words, with an article.
        centre: (2,) x, y [m], world frame.
        corners: (4, 2) [m] of its outline, in order around it; None for a small thing.
    """

    name: str
    centre: np.ndarray
    corners: np.ndarray | None = None


@dataclass(frozen=True)
class Mark:
    """Words before and after a name: ("left", ""), or ("", "nearest to the fridge")."""

    before: str = ""
    after: str = ""


def mark(
    points: np.ndarray,
    left: np.ndarray | None,
    near: Sequence[Landmark],
    far: Sequence[Landmark],
    superlatives: bool = False,
) -> Mark | None:
    """Find words that fit a thing and none of the others.

    Args:
        points: (1 + N, 2) positions x, y [m], world frame: of the thing, then of the others, at least one.
        left: (2,) unit vector to the left of somebody who faces the front; None where there is no front.
        near: landmarks that lie beside the thing, which are preferred.
        far: other landmarks.
        superlatives: only words that stay true where some of the others are not there, so not "left".

    Returns:
        The words; None if everything is in one place, or with ``superlatives`` if no such words are safe.
    """
    best = (0.0, Mark())
    for found, sure in _tiers(points, left, near, far, superlatives):
        margin, words = max(found, key=lambda each: each[0], default=(0.0, Mark()))
        # The first kind of words that is sure, not the one with the widest margin: left and right are easier to follow.
        if margin >= sure:
            return words
        best = max(best, (margin, words), key=lambda each: each[0])
    return best[1] if best[0] > (LEAST_M if superlatives else 0.0) else None


def _tiers(
    points: np.ndarray,
    left: np.ndarray | None,
    near: Sequence[Landmark],
    far: Sequence[Landmark],
    superlatives: bool,
) -> Iterator[tuple[list[tuple[float, Mark]], float]]:
    """Words by preference, each with its margin [m], and the margin that suffices; see `mark`."""
    if left is not None and not superlatives:
        yield _sides(points @ left), SURE_SIDE_M
    if near:
        yield _ranked(near, _distances(near, points), _NEAREST), SURE_M
    if far:
        distances = _distances(far, points)
        yield _ranked(far, distances, _NEAREST), SURE_M
        yield _ranked(far, distances, _FURTHEST), SURE_M
        if not superlatives:
            yield _ranked(far, distances, _BETWEEN), SURE_M


def _sides(along: np.ndarray) -> list[tuple[float, Mark]]:
    """Margin [m] and words of the sides, of coordinates (1 + N,) to the left, the thing's first."""
    here = along[0]
    others = along[1:]
    # Of two things one is left; of more it takes a superlative.
    few = len(others) == 1
    return [
        (float(here - others.max()), Mark("left" if few else "leftmost")),
        (float(others.min() - here), Mark("right" if few else "rightmost")),
    ]


def _ranked(
    landmarks: Sequence[Landmark], distances: np.ndarray, words: Sequence[str]
) -> list[tuple[float, Mark]]:
    """Margin [m] and words of the place that a thing has among all by their distances to each landmark.

    Args:
        landmarks: L landmarks.
        distances: (L, 2, 1 + N) of `_distances`, the thing's first.
        words: `_FURTHEST`, or the words of the places from the nearest on, "" for one that is not told.
    """
    others = distances[:, :, 1:]
    own = distances[:, :, :1]
    ranks = (others < own).sum(axis=2).tolist()
    # The nearest rival decides how sure the words are.
    margins = np.abs(others - own).min(axis=(1, 2)).tolist()
    last = others.shape[2]
    found = []
    for landmark, (rank, by_outline), margin in zip(
        landmarks, ranks, margins, strict=True
    ):
        # Near by its centre but not by its outline: people would disagree about what is nearest.
        if rank != by_outline:
            continue
        word = words[0] if rank == last and words is _FURTHEST else ""
        if words is not _FURTHEST and rank < min(len(words), last):
            word = words[rank]
        if word:
            found.append((margin, Mark(after=f"{word} {landmark.name}")))
    return found


def _distances(landmarks: Sequence[Landmark], points: np.ndarray) -> np.ndarray:
    """(L, 2, N) distances [m] of points (N, 2) to landmarks: to the centre, and to the outline if there is one."""
    centres = np.array([landmark.centre for landmark in landmarks])
    to_centre = np.linalg.norm(points - centres[:, None], axis=2)
    found = np.stack([to_centre, to_centre], axis=1)
    outlined = [i for i, each in enumerate(landmarks) if each.corners is not None]
    if outlined:
        corners = np.array([landmarks[i].corners for i in outlined])
        found[outlined, 1] = _outside(points, corners)
    return found


def _outside(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(L, N) distances [m] of points (N, 2) to rectangles with corners (L, 4, 2), 0 within them."""
    origins = corners[:, :1]
    axes = corners[:, [1, 3]] - origins
    sizes = np.linalg.norm(axes, axis=2)
    local = (points - origins) @ (axes / sizes[:, :, None]).transpose(0, 2, 1)
    # In the frame of the rectangle the nearest point is found axis by axis.
    inside = np.clip(local, 0.0, sizes[:, None])
    return np.linalg.norm(local - inside, axis=2)
