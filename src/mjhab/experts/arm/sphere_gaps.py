"""The inner loop of the experts' planning, compiled: how near spheres on moving links come to boxes."""

from __future__ import annotations

import numpy as np

from mjhab.core.kernels.box_gaps import box_gap
from mjhab.experts.jit import inline, kernel

Array = np.ndarray


@inline
def _place(pos: Array, rot: Array, local: Array) -> tuple[float, float, float]:
    """A point of a link in the world."""
    x = pos[0] + rot[0, 0] * local[0] + rot[0, 1] * local[1] + rot[0, 2] * local[2]
    y = pos[1] + rot[1, 0] * local[0] + rot[1, 1] * local[1] + rot[1, 2] * local[2]
    z = pos[2] + rot[2, 0] * local[0] + rot[2, 1] * local[1] + rot[2, 2] * local[2]
    return x, y, z


@inline
def _turned(rot: Array, local: Array) -> tuple[float, float, float]:
    """A direction of a link in the world."""
    x = rot[0, 0] * local[0] + rot[0, 1] * local[1] + rot[0, 2] * local[2]
    y = rot[1, 0] * local[0] + rot[1, 1] * local[1] + rot[1, 2] * local[2]
    z = rot[2, 0] * local[0] + rot[2, 1] * local[1] + rot[2, 2] * local[2]
    return x, y, z


@kernel
def least_gaps(
    pos: Array,
    rot: Array,
    links: Array,
    middle: Array,
    around: Array,
    first: Array,
    points: Array,
    radius: Array,
    center: Array,
    half: Array,
    turn: Array,
) -> Array:
    """Least distance (N,) [m] of any sphere to any box; negative: they overlap.

    Spheres around whole links tell which few pairs of link and box can be nearest; only their spheres are looked at.

    Args:
        pos, rot: (N, Q, 3), (N, Q, 3, 3) frames of the chain's links in N configurations.
        links: (L,) those that have spheres. middle, around: (L, 3), (L,) spheres around all of a link, in its frame.
        first: (L + 1,) where each link's spheres begin among ``points`` (M, 3), in its frame, and ``radius`` (M,).
        center, half, turn: (K, 3), (K, 3), (K, 3, 3) the boxes.
    """
    found = np.empty(len(pos))
    least = np.empty((len(links), len(center)))
    for n in range(len(pos)):
        nearest = np.inf
        for i, link in enumerate(links):
            x, y, z = _place(pos[n, link], rot[n, link], middle[i])
            for k in range(len(center)):
                gap = box_gap(x, y, z, center[k], half[k], turn[k])
                least[i, k] = gap - around[i]
                nearest = min(nearest, gap + around[i])
        best = np.inf
        for i, link in enumerate(links):
            for k in range(len(center)):
                if least[i, k] > min(nearest, best):
                    continue
                for m in range(first[i], first[i + 1]):
                    x, y, z = _place(pos[n, link], rot[n, link], points[m])
                    best = min(best, box_gap(x, y, z, center[k], half[k], turn[k]) - radius[m])
        found[n] = best
    return found


@kernel
def own_gaps(
    pos: Array,
    rot: Array,
    link: Array,
    points: Array,
    radius: Array,
    trunk: Array,
    center: Array,
    half: Array,
    turn: Array,
) -> Array:
    """Least distance (N,) [m] of spheres on links to boxes on other links of the same robot; negative: they overlap.

    Args:
        pos, rot: (N, Q, 3), (N, Q, 3, 3) frames of the chain's links in N configurations.
        link, points, radius: (M,), (M, 3), (M,) spheres in their links' frames.
        trunk, center, half, turn: (K,), (K, 3), (K, 3), (K, 3, 3) links of the boxes, and the boxes in their frames.
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
                gap = box_gap(spheres[m, 0], spheres[m, 1], spheres[m, 2], middle, half[k], sides)
                best = min(best, gap - radius[m])
        found[n] = best
    return found
