"""Distances of points to oriented boxes, compiled. Lengths [m]. Letters: P points, K boxes."""

from __future__ import annotations

import numpy as np

from mjhab.core.kernels.jit import compiler


@compiler("core.kernels.box_gaps", forceinline=True)
def box_gap(
    x: float, y: float, z: float, center: np.ndarray, half: np.ndarray, rot: np.ndarray
) -> float:
    """Signed distance of a point to one box: negative inside, exact outside."""
    dx = x - center[0]
    dy = y - center[1]
    dz = z - center[2]
    outside = 0.0
    inside = -np.inf
    for axis in range(3):
        over = abs(dx * rot[0, axis] + dy * rot[1, axis] + dz * rot[2, axis]) - half[axis]
        inside = max(inside, over)
        if over > 0.0:
            outside += over * over
    # One of the two is 0 for every point.
    return np.sqrt(outside) + min(inside, 0.0)


@compiler("core.kernels.box_gaps")
def least_box_gaps(
    points: np.ndarray, center: np.ndarray, half: np.ndarray, rot: np.ndarray
) -> np.ndarray:
    """Distance (P,) of each of ``points`` (P, 3) to the nearest box; infinite when there is none.

    ``center``, ``half``, ``rot``: (K, 3), (K, 3), (K, 3, 3) the boxes.
    """
    found = np.full(len(points), np.inf)
    # Computed once for all points: it rejects most boxes without turning into their frames.
    corner = np.sqrt((half * half).sum(axis=1))
    for p in range(len(points)):
        x = points[p, 0]
        y = points[p, 1]
        z = points[p, 2]
        least = np.inf
        for k in range(len(center)):
            # A box is at least as far as the sphere around it.
            dx = x - center[k, 0]
            dy = y - center[k, 1]
            dz = z - center[k, 2]
            far = least + corner[k]
            # Squares would hide the sign: a point deep inside of a box makes ``far`` negative.
            if far < 0.0 or dx * dx + dy * dy + dz * dz > far * far:
                continue
            least = min(least, box_gap(x, y, z, center[k], half[k], rot[k]))
        found[p] = least
    return found
