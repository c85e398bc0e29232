"""Where a camera stands that follows the robot: behind its shoulder, with nothing tall in between."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from mjhab.core.boxes import Boxes, sphere_box_distance
from mjhab.core.rotations import mat_from_quat

FOLLOW_EYES = (
    (-0.7, 1.6, 2.3),
    (-0.7, -1.6, 2.3),
    (-1.4, 0.9, 2.6),
    (-1.4, -0.9, 2.6),
    (-0.4, 0.5, 3.6),
)
"""Candidate positions of the follow camera in the frame of the robot: forward, left, height [m]. The first one with an
unobstructed view of the robot is used."""
FOLLOW_TARGET = (0.45, 0.85)
"""Point that the follow camera looks at: distance ahead of the robot, and height [m]."""
TALL = 1.3
"""Furniture above this height can hide the robot [m]."""


class FollowCamera:
    """Chooses the place of the follow camera.

    Args:
        model: the compiled model of a home, by its name.
    """

    def __init__(self, model: Callable[[str], mujoco.MjModel]) -> None:
        self._model = model
        self._tall_boxes: dict[str, Boxes] = {}

    def look(self, home: str, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) and target (3,) of the camera [m] for a robot base at x, y [m], yaw [rad] (3,)."""
        x, y, yaw = base
        forward = np.array([np.cos(yaw), np.sin(yaw)])
        left = np.array([-np.sin(yaw), np.cos(yaw)])
        here = np.array([x, y])
        target = np.append(here + FOLLOW_TARGET[0] * forward, FOLLOW_TARGET[1])
        eyes = [np.append(here + f * forward + s * left, h) for f, s, h in FOLLOW_EYES]
        return next((e for e in eyes if self._in_view(home, e, target)), eyes[-1]), target

    def _in_view(self, home: str, eye: np.ndarray, target: np.ndarray) -> bool:
        """Whether no tall furniture lies between the camera and the target."""
        share = np.linspace(0.0, 0.75, 12)[:, None]
        return bool(
            (sphere_box_distance(eye + share * (target - eye), self.tall(home)) > 0.05).all()
        )

    def tall(self, home: str) -> Boxes:
        """Boxes of the furniture and walls of a home that can hide the robot."""
        if home not in self._tall_boxes:
            model = self._model(home)
            rot = mat_from_quat(model.geom_quat)
            # geom_aabb holds centre and half-extents in the geom's frame, also for meshes.
            center = model.geom_pos + np.einsum("kij,kj->ki", rot, model.geom_aabb[:, :3])
            half = model.geom_aabb[:, 3:]
            top = center[:, 2] + np.einsum("kj,kj->k", np.abs(rot[:, 2]), half)
            keep = (
                (model.geom_bodyid == 0)
                & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE))
                & (top > TALL)
            )
            self._tall_boxes[home] = Boxes.of(center[keep], half[keep], rot[keep])
        return self._tall_boxes[home]
