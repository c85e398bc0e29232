"""Compiled clearance kernels: least distances between spheres on links and oriented boxes. World frame, lengths [m]."""

from __future__ import annotations

import numpy as np

from mjhab.core.kernels.box_gaps import box_gap
from mjhab.experts.jit import inline, kernel


@inline
def _place(
    pos: np.ndarray, rot: np.ndarray, local: np.ndarray
) -> tuple[float, float, float]:
    """World position of point ``local`` (3,) of a link with frame ``pos`` (3,), ``rot`` (3, 3)."""
    x = pos[0] + rot[0, 0] * local[0] + rot[0, 1] * local[1] + rot[0, 2] * local[2]
    y = pos[1] + rot[1, 0] * local[0] + rot[1, 1] * local[1] + rot[1, 2] * local[2]
    z = pos[2] + rot[2, 0] * local[0] + rot[2, 1] * local[1] + rot[2, 2] * local[2]
    return x, y, z


@inline
def _turned(rot: np.ndarray, local: np.ndarray) -> tuple[float, float, float]:
    """World direction of vector ``local`` (3,) of a link with rotation ``rot`` (3, 3)."""
    x = rot[0, 0] * local[0] + rot[0, 1] * local[1] + rot[0, 2] * local[2]
    y = rot[1, 0] * local[0] + rot[1, 1] * local[1] + rot[1, 2] * local[2]
    z = rot[2, 0] * local[0] + rot[2, 1] * local[1] + rot[2, 2] * local[2]
    return x, y, z


@kernel
def min_gaps(
    pos: np.ndarray,
    rot: np.ndarray,
    links: np.ndarray,
    middle: np.ndarray,
    around: np.ndarray,
    first: np.ndarray,
    points: np.ndarray,
    radius: np.ndarray,
    center: np.ndarray,
    half: np.ndarray,
    turn: np.ndarray,
) -> np.ndarray:
    """Least distance (N,) [m] of any sphere to any box; negative: they overlap.

    The bounding spheres of the links select the pairs of link and box that can be nearest; only the spheres of these
    pairs are compared with the box.

    Args:
        pos: (N, I, 3) positions of the chain's I links in N configurations.
        rot: (N, I, 3, 3) rotations of these links.
        links: (L,) indices of the links that have spheres.
        middle: (L, 3) centre of each link's bounding sphere, in the link's frame.
        around: (L,) radius of each link's bounding sphere.
        first: (L + 1,) index of each link's first sphere.
        points: (M, 3) centres of the spheres, sorted by link, in the frames of the links.
        radius: (M,) radii of the spheres.
        center: (K, 3) centres of the boxes.
        half: (K, 3) half sizes of the boxes.
        turn: (K, 3, 3) rotations of the boxes.
    """
    found = np.empty(len(pos))
    lower = np.empty((len(links), len(center)))
    for n in range(len(pos)):
        nearest = np.inf
        for i, link in enumerate(links):
            x, y, z = _place(pos[n, link], rot[n, link], middle[i])
            for k in range(len(center)):
                gap = box_gap(x, y, z, center[k], half[k], turn[k])
                lower[i, k] = gap - around[i]
                # The nearest sphere of the link is not farther than this: an upper bound on the distance that is looked
                # for.
                nearest = min(nearest, gap + around[i])
        best = np.inf
        for i, link in enumerate(links):
            for k in range(len(center)):
                # Not even the nearest sphere of the link could be nearer than what is known.
                if lower[i, k] > min(nearest, best):
                    continue
                for m in range(first[i], first[i + 1]):
                    x, y, z = _place(pos[n, link], rot[n, link], points[m])
                    best = min(
                        best, box_gap(x, y, z, center[k], half[k], turn[k]) - radius[m]
                    )
        found[n] = best
    return found


@kernel
def own_gaps(
    pos: np.ndarray,
    rot: np.ndarray,
    link: np.ndarray,
    points: np.ndarray,
    radius: np.ndarray,
    trunk: np.ndarray,
    center: np.ndarray,
    half: np.ndarray,
    turn: np.ndarray,
) -> np.ndarray:
    """Least distance (N,) [m] of spheres on links to boxes on other links of the same robot; negative: they overlap.

    Args:
        pos: (N, I, 3) positions of the chain's I links in N configurations.
        rot: (N, I, 3, 3) rotations of these links.
        link: (M,) index of each sphere's link.
        points: (M, 3) centres of the spheres in the frames of their links.
        radius: (M,) radii of the spheres.
        trunk: (K,) index of each box's link.
        center: (K, 3) centres of the boxes in the frames of their links.
        half: (K, 3) half sizes of the boxes.
        turn: (K, 3, 3) rotations of the boxes in the frames of their links.
    """
    found = np.empty(len(pos))
    spheres = np.empty((len(link), 3))
    middle = np.empty(3)
    sides = np.empty((3, 3))
    for n in range(len(pos)):
        for m in range(len(link)):
            x, y, z = _place(pos[n, link[m]], rot[n, link[m]], points[m])
            spheres[m, 0] = x
            spheres[m, 1] = y
            spheres[m, 2] = z
        best = np.inf
        for k in range(len(trunk)):
            x, y, z = _place(pos[n, trunk[k]], rot[n, trunk[k]], center[k])
            middle[0] = x
            middle[1] = y
            middle[2] = z
            for axis in range(3):
                x, y, z = _turned(rot[n, trunk[k]], turn[k, :, axis])
                sides[0, axis] = x
                sides[1, axis] = y
                sides[2, axis] = z
            for m in range(len(link)):
                gap = box_gap(
                    spheres[m, 0], spheres[m, 1], spheres[m, 2], middle, half[k], sides
                )
                best = min(best, gap - radius[m])
        found[n] = best
    return found
