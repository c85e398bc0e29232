"""The object in the hand: whether it is held, and the spheres that cover it.

Lengths [m], world frame. Letters: H spheres.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import itertools

import numpy as np

from mjhab.core.rotations import mat_from_quat
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import motion

CORNER_RADIUS_M = 0.012
"""Radius of the spheres in the corners of a held box."""


def holds(view: WorldView, obj: str) -> bool:
    """Whether a finger presses an object with more than 0.1 N."""
    return bool((view.finger_forces(obj) > 0.1).any())


def held_spheres(view: WorldView, obj: str) -> tuple[np.ndarray, np.ndarray]:
    """Spheres that cover the bounding box of an object in the hand: centres (H, 3) in the tool frame, radii (H,)."""
    pos, rot = motion.tcp(view)
    pose = view.object_pose(obj)
    half = np.array(view.object_type(obj).half)
    # Thin things get spheres that stand out a little: few of them matter more than millimetres.
    radius = max(float(half.min()), 0.5 * float(np.sort(half)[1]))
    axes = []
    for size in half:
        span = max(size - radius, 0.0)
        axes.append(np.linspace(-span, span, 1 + int(np.ceil(2 * span / (1.3 * radius)))))
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    size = np.full(len(grid), radius)
    if view.object_shape(obj).kind in ("box", "mesh"):
        # The larger spheres leave out the corners, and a collision of a corner knocks the object out of the hand.
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * (
            half - CORNER_RADIUS_M
        )
        grid = np.concatenate([grid, corners])
        size = np.append(size, np.full(len(corners), CORNER_RADIUS_M))
    world = pose[:3] + grid @ mat_from_quat(pose[3:]).T
    return (world - pos) @ rot, size
