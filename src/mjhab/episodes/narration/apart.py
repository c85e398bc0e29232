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

    def distances(self, points: np.ndarray) -> np.ndarray:
        """(K, N) [m] distances of points (N, 2) to the centre and, of furniture, to the outline."""
        centre = np.linalg.norm(points - self.centre, axis=1)
        if self.corners is None:
            return centre[None]
        return np.stack([centre, _outside(points, self.corners)])


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
    yield _ranked(points, near, _NEAREST), SURE_M
    yield _ranked(points, far, _NEAREST), SURE_M
    yield _ranked(points, far, _FURTHEST), SURE_M
    if not superlatives:
        yield _ranked(points, far, _BETWEEN), SURE_M


def _sides(along: np.ndarray) -> list[tuple[float, Mark]]:
    """Margin [m] and words of the sides, of coordinates (1 + N,) to the left, the thing's first."""
    here = along[0]
    others = along[1:]
    few = len(others) == 1
    return [
        (float(here - others.max()), Mark("left" if few else "leftmost")),
        (float(others.min() - here), Mark("right" if few else "rightmost")),
    ]


def _ranked(
    points: np.ndarray, landmarks: Sequence[Landmark], words: Sequence[str]
) -> list[tuple[float, Mark]]:
    """Margin [m] and words of the place that a thing has among all by their distances to each landmark.

    Args:
        points: (1 + N, 2) positions [m], the thing's first.
        landmarks: what distances are told from.
        words: `_FURTHEST`, or the words of the places from the nearest on, "" for one that is not told.
    """
    found = []
    for landmark in landmarks:
        d = landmark.distances(points)
        ranks = (d[:, 1:] < d[:, :1]).sum(axis=1)
        if ranks.min() != ranks.max():
            continue
        rank = int(ranks[0])
        last = len(points) - 1
        word = words[0] if rank == last and words is _FURTHEST else ""
        if words is not _FURTHEST and rank < min(len(words), last):
            word = words[rank]
        if word:
            margin = float(np.abs(d[:, 1:] - d[:, :1]).min())
            found.append((margin, Mark(after=f"{word} {landmark.name}")))
    return found


def _outside(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(N,) distances [m] of points (N, 2) to a rectangle with corners (4, 2), 0 within it."""
    origin = corners[0]
    axes = np.stack([corners[1] - origin, corners[3] - origin])
    sizes = np.linalg.norm(axes, axis=1)
    local = (points - origin) @ (axes / sizes[:, None]).T
    return np.linalg.norm(local - np.clip(local, 0.0, sizes), axis=1)
