"""Noise of sensing and acting: blur, holes and steps in depth, late and inexact actions, wheels that slip."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from mjhab.config.perturbing import (
    ActionFrame,
    Drawn,
    Perturbation,
    PictureFrame,
    Quantity,
)
from mjhab.envs.perturbations.pixels import EPISODES_KEPT, blur, holes, rounded
from mjhab.robots.robot import Robot

BLOCK = 64
"""Control steps whose noise of actions is drawn at once, because a stream costs more to begin than to use."""
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
            blur(images["rgb"], drawn.amounts["blur"])
        if "depth" in images:
            # Before the holes, so that a hole stays exactly 0.
            rounded(images["depth"], drawn.amounts["steps"] / MM_PER_M)
        for name in ("depth", "target_depth"):
            if name in images:
                key = _key(drawn.level, drawn.seed, drawn.index)
                holes(images[name], key, frame.step, drawn.amounts["holes"])

    def delay(self, drawn: Drawn) -> int:
        """That of the level."""
        return int(drawn.amounts["delay"])

    def act(
        self, drawn: Drawn, action: np.ndarray, frame: ActionFrame, step: int
    ) -> np.ndarray:
        """Add noise to all entries but the gripper's, and take away what slips of the base's."""
        block, row = divmod(step, BLOCK)
        bells = _bells(drawn.level, drawn.seed, drawn.index, block, len(action))
        noise = drawn.amounts["action"] * bells[row]
        # A trembling gripper would let go of what it holds.
        noise[frame.gripper] = 0.0
        found = action + noise * frame.half
        found[list(frame.base)] *= drawn.values["grip"]
        return found.astype(np.float32)


def _bare(level: int, seed: int, index: int) -> Drawn:
    """The axis in an episode, for its streams alone."""
    return Drawn(seed, index, NOISE.name, level, {})


@lru_cache(maxsize=EPISODES_KEPT)
def _key(level: int, seed: int, index: int) -> np.uint64:
    """What the holes of an episode are counted from."""
    # A stream of its own: the kernel counts from here, pixel by pixel.
    random = _bare(level, seed, index).stream("holes")
    return random.integers(2**64, dtype=np.uint64)


@lru_cache(maxsize=EPISODES_KEPT)
def _bells(level: int, seed: int, index: int, block: int, entries: int) -> np.ndarray:
    """(BLOCK, entries) normal numbers for a block of control steps."""
    return _bare(level, seed, index).stream("act", block).normal(size=(BLOCK, entries))


NOISE = NoiseAxis()
