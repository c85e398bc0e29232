"""Pose of the follow camera: behind the robot's shoulder, chosen so that no tall furniture hides the robot."""

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
    """Choose the position of the follow camera for a pose of the robot's base.

    Args:
        model: returns the compiled model of a home, given the home's name.
    """

    def __init__(self, model: Callable[[str], mujoco.MjModel]) -> None:
        self._model = model
        self._tall_boxes: dict[str, Boxes] = {}

    def look(self, home: str, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute where the camera stands and what it looks at.

        Args:
            home: name of the home.
            base: (3,) pose of the robot's base: x, y [m], yaw [rad].

        Returns:
            Position (3,) and target (3,) in the world [m]. The last of `FOLLOW_EYES` is used if all are obstructed.
        """
        x, y, yaw = base
        forward = np.array([np.cos(yaw), np.sin(yaw)])
        left = np.array([-np.sin(yaw), np.cos(yaw)])
        here = np.array([x, y])
        target = np.append(here + FOLLOW_TARGET[0] * forward, FOLLOW_TARGET[1])
        eyes = [np.append(here + f * forward + s * left, h) for f, s, h in FOLLOW_EYES]
        # The last one is high above, from where little is hidden.
        return next((e for e in eyes if self._in_view(home, e, target)), eyes[-1]), target

    def _in_view(self, home: str, eye: np.ndarray, target: np.ndarray) -> bool:
        """Whether the first 3/4 of the line from ``eye`` to ``target``, both (3,) [m], are clear of tall furniture."""
        # Not all of the way: furniture that the robot stands at may be tall.
        share = np.linspace(0.0, 0.75, 12)[:, None]
        return bool(
            (
                sphere_box_distance(eye + share * (target - eye), self.tall(home)) > 0.05
            ).all()
        )

    def tall(self, home: str) -> Boxes:
        """Bounding boxes, in the world, of the static geoms of a home whose top is above `TALL`; cached per home."""
        if home not in self._tall_boxes:
            model = self._model(home)
            rot = mat_from_quat(model.geom_quat)
            # geom_aabb holds centre and half-extents in the geom's frame, also for meshes.
            center = model.geom_pos + np.einsum("kij,kj->ki", rot, model.geom_aabb[:, :3])
            half = model.geom_aabb[:, 3:]
            top = center[:, 2] + np.einsum("kj,kj->k", np.abs(rot[:, 2]), half)
            keep = (
                (model.geom_bodyid == 0)
                # The floor is a plane without end, whose box says nothing.
                & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE))
                & (top > TALL)
            )
            self._tall_boxes[home] = Boxes.of(center[keep], half[keep], rot[keep])
        return self._tall_boxes[home]
