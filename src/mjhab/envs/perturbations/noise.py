"""Noise of sensing and acting: blur, holes and steps in depth, late and inexact actions, wheels that slip."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjhab.config.perturbing import (
    ActionFrame,
    Drawn,
    Perturbation,
    PictureFrame,
    Quantity,
)
from mjhab.envs.perturbations.pixels import blur
from mjhab.robots.robot import Robot

HOLE_PX = 2
"""Side of the smallest hole in a depth image [px]; neighbouring ones make larger holes."""
MM_PER_M = 1000.0


class NoiseAxis(Perturbation):
    """What sensors lose and actuators miss, anew in every control step; the delay and the slip hold for the episode."""

    name = "noise"
    about = (
        "blur, holes and steps in depth images, late and inexact actions, slipping wheels"
    )
    quantities = {  # noqa: RUF012
        "blur": Quantity(
            "px", (0.3, 0.5, 0.7, 1.0, 1.5), "Gaussian blur of colour images"
        ),
        "holes": Quantity(
            "", (0.01, 0.02, 0.05, 0.1, 0.2), "share of depth images without a distance"
        ),
        "steps": Quantity("mm", (2.0, 5.0, 10.0, 20.0, 40.0), "steps of measured depth"),
        "delay": Quantity(
            "control steps", (1, 1, 2, 2, 3), "from an action to its execution"
        ),
        "action": Quantity(
            "",
            (0.01, 0.02, 0.05, 0.1, 0.15),
            "standard deviation of actions, in halves of their range",
        ),
        "slip": Quantity(
            "", (0.02, 0.05, 0.1, 0.2, 0.3), "largest share of a drive that is lost"
        ),
    }

    def draw(self, drawn: Drawn, robot: Robot) -> Mapping[str, Any]:
        """How much of a command the base follows."""
        lost = drawn.amounts["slip"] * float(drawn.stream("slip").uniform(0.0, 1.0))
        return {"grip": 1.0 - lost}

    def picture(
        self, drawn: Drawn, images: Mapping[str, np.ndarray], frame: PictureFrame
    ) -> None:
        """Blur "rgb"; holes and steps in "depth", the same holes in "target_depth"."""
        if "rgb" in images:
            for rgb in images["rgb"]:
                blur(rgb, drawn.amounts["blur"])
        holes: np.ndarray | None = None
        for name in ("depth", "target_depth"):
            if name in images:
                image = images[name]
                if holes is None:
                    holes = _holes(drawn, image.shape, frame.step)
                image[holes] = 0
        if "depth" in images:
            step = np.float32(drawn.amounts["steps"] / MM_PER_M)
            images["depth"][:] = np.round(images["depth"] / step) * step

    def delay(self, drawn: Drawn) -> int:
        """That of the level."""
        return int(drawn.amounts["delay"])

    def act(
        self, drawn: Drawn, action: np.ndarray, frame: ActionFrame, step: int
    ) -> np.ndarray:
        """Add noise to all entries but the gripper's, and take away what slips of the base's."""
        noise = drawn.stream("act", step).normal(
            0.0, drawn.amounts["action"], len(action)
        )
        noise[frame.gripper] = 0.0
        found = action + noise * frame.half
        found[list(frame.base)] *= drawn.values["grip"]
        return found.astype(np.float32)


def _holes(drawn: Drawn, shape: tuple[int, ...], step: int) -> np.ndarray:
    """(C, h, w) bool: where the images of a control step have holes."""
    cameras, height, width = shape
    rows, columns = -(-height // HOLE_PX), -(-width // HOLE_PX)
    lost = (
        drawn.stream("holes", step).random((cameras, rows, columns))
        < drawn.amounts["holes"]
    )
    fine = lost.repeat(HOLE_PX, axis=1).repeat(HOLE_PX, axis=2)
    return fine[:, :height, :width]


NOISE = NoiseAxis()
