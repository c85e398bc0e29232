"""Light: dimmer or brighter, warmer or colder, and falling from one side."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from mjhab.config.perturbing import Drawn, Perturbation, PictureFrame, Quantity
from mjhab.envs.perturbations.pixels import EPISODES_KEPT, light_table, relight
from mjhab.robots.robot import Robot


class LightAxis(Perturbation):
    """The light of colour images: changed where it arrives, on the surfaces that a picture shows."""

    name = "light"
    about = "brightness, colour and direction of the light, shade of what is turned away, shadows"
    quantities = {  # noqa: RUF012
        "stops": Quantity(
            "EV", (0.25, 0.5, 0.75, 1.0, 1.5), "brighter or darker, a factor of 2 per EV"
        ),
        "tint": Quantity(
            "",
            (0.03, 0.06, 0.1, 0.15, 0.2),
            "more red and less blue, or the other way round",
        ),
        "side": Quantity(
            "", (0.1, 0.2, 0.3, 0.45, 0.6), "share of the light that comes from one side"
        ),
        "shadows": Quantity(
            "",
            (0, 0, 1, 1, 1),
            "whether what stands in the way of the light from the side throws shadows",
        ),
    }
    needs = ("depth",)
    images = ("rgb",)

    def draw(self, drawn: Drawn, robot: Robot) -> Mapping[str, Any]:
        """Gain of red, green and blue, and the direction to the light (3,), world frame."""
        random = drawn.stream()
        amounts = drawn.amounts
        # The whole amount, brighter or darker, so that levels do not overlap.
        gain = 2.0 ** (amounts["stops"] * float(random.choice((-1.0, 1.0))))
        tint = amounts["tint"] * float(random.choice((-1.0, 1.0)))
        around = float(random.uniform(-np.pi, np.pi))
        height = float(random.uniform(0.2, 0.9))
        flat = np.sqrt(1.0 - height**2)
        return {
            "gain": [gain * (1.0 + tint), gain, gain * (1.0 - tint)],
            "from": [
                float(flat * np.cos(around)),
                float(flat * np.sin(around)),
                height,
            ],
        }

    def picture(
        self, drawn: Drawn, images: Mapping[str, np.ndarray], frame: PictureFrame
    ) -> None:
        """Change "rgb" by the gain and by how far a surface is turned to the light."""
        if "rgb" not in images:
            return
        table = _table(tuple(drawn.values["gain"]), drawn.amounts["side"])
        # Into the axes of the cameras: columns of the matrix are these in the world.
        toward = np.array(drawn.values["from"]) @ frame.mat
        shadows = bool(drawn.amounts["shadows"])
        relight(images["rgb"], images["depth"], frame.focal, toward, table, shadows)


@lru_cache(maxsize=EPISODES_KEPT)
def _table(gain: tuple[float, ...], side: float) -> np.ndarray:
    """`light_table`, kept, because every image of an episode needs it."""
    return light_table(np.array(gain), side)


LIGHT = LightAxis()
