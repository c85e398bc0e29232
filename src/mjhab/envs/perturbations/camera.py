"""Camera: a bumped mount and another lens."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjhab.config.perturbing import Drawn, MountChange, Perturbation, Quantity
from mjhab.robots.robot import Robot


class CameraAxis(Perturbation):
    """Every camera is shifted and turned in a direction of its own, and has another field of view."""

    name = "camera"
    about = "pose and field of view of every camera; calibrations stay as they were"
    quantities = {  # noqa: RUF012
        "shift": Quantity("m", (0.005, 0.01, 0.02, 0.035, 0.05), "length of the shift"),
        "turn": Quantity("deg", (1.0, 2.0, 4.0, 7.0, 10.0), "angle of the turn"),
        "widen": Quantity(
            "", (0.02, 0.04, 0.08, 0.12, 0.16), "change of the width of the image"
        ),
    }

    def draw(self, drawn: Drawn, robot: Robot) -> Mapping[str, Any]:
        """Shift [m], turn [rad] and factor of the width by camera."""
        amounts = drawn.amounts
        found = {}
        for camera in robot.camera_names:
            # A stream per camera: one more camera does not move the others.
            random = drawn.stream(camera)
            # The whole amount of the level, to one side or the other, so that levels do not overlap.
            widen = amounts["widen"] * float(random.choice((-1.0, 1.0)))
            found[camera] = {
                "shift": (amounts["shift"] * _direction(random)).tolist(),
                "turn": (np.radians(amounts["turn"]) * _direction(random)).tolist(),
                "widen": 1.0 + widen,
            }
        return found

    def mount(self, drawn: Drawn, camera: str) -> MountChange:
        """The change that `draw` drew."""
        own = drawn.values[camera]
        return MountChange(np.array(own["shift"]), np.array(own["turn"]), own["widen"])


def _direction(random: np.random.Generator) -> np.ndarray:
    """A unit vector (3,), all directions alike."""
    # Three normal numbers have no preferred direction, unlike those from a cube.
    vector = random.normal(size=3)
    return vector / np.sqrt(np.square(vector).sum())


CAMERA = CameraAxis()
