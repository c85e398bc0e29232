"""Colours: furniture, walls, objects and the robot in other ones, with the patterns and textures of others."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from mjhab.config.perturbing import Drawn, Perturbation, PictureFrame, Quantity
from mjhab.envs.perturbations.pixels import EPISODES_KEPT, recolour

IDS = 1024
"""Segments whose colours are drawn; the one with id i has those of number i modulo IDS."""
LUMA = (0.2126, 0.7152, 0.0722)
"""Shares of red, green and blue in the brightness of linear light (ITU-R BT.709)."""


class ColoursAxis(Perturbation):
    """Every segment of colour images has another hue, saturation and brightness, and some have another's pattern."""

    name = "colours"
    about = "hue, saturation, brightness and texture of furniture, walls, floors, links and objects"
    quantities = {  # noqa: RUF012
        "hue": Quantity(
            "deg", (10.0, 20.0, 40.0, 80.0, 180.0), "largest turn of the hue"
        ),
        "saturation": Quantity(
            "", (0.1, 0.2, 0.4, 0.6, 0.8), "largest change of the saturation"
        ),
        "brightness": Quantity(
            "", (0.05, 0.1, 0.2, 0.3, 0.4), "largest change of the brightness"
        ),
        "textures": Quantity(
            "",
            (0.1, 0.2, 0.4, 0.6, 0.8),
            "share of the materials that are drawn as another one of the home",
        ),
    }
    needs = ("seg",)
    images = ("rgb",)

    def looks(self, drawn: Drawn, image: np.ndarray) -> np.ndarray:
        """Draw some materials as others: patterns as patterns or plain ones, images of meshes as other images."""
        random = drawn.stream("textures")
        chosen = random.random(len(image)) < drawn.amounts["textures"]
        found = np.arange(len(image))
        # Images of meshes are laid out for their mesh, and patterns for any.
        for group in (image, ~image):
            every = np.flatnonzero(group)
            # Drawn for all materials, chosen or not, so that a level changes no other choice.
            other = random.integers(max(len(every), 1), size=len(every))
            found[every] = np.where(chosen[every], every[other], every)
        return found

    def picture(
        self, drawn: Drawn, images: Mapping[str, np.ndarray], frame: PictureFrame
    ) -> None:
        """Change "rgb", segment by segment."""
        if "rgb" not in images:
            return
        mixes = _mixes(drawn)
        recolour(images["rgb"], images["seg"], mixes)


def _mixes(drawn: Drawn) -> np.ndarray:
    """(IDS, 3, 3) float32, the matrix of each segment in linear light; that of the background changes nothing."""
    # Kept, because every image of an episode needs them.
    return _kept_mixes(drawn.level, drawn.seed, drawn.index)


@lru_cache(maxsize=EPISODES_KEPT)
def _kept_mixes(level: int, seed: int, index: int) -> np.ndarray:
    size = {
        name: quantity.levels[level - 1] for name, quantity in COLOURS.quantities.items()
    }
    random = Drawn(seed, index, COLOURS.name, level, size).stream()
    hue = np.radians(size["hue"]) * random.uniform(-1.0, 1.0, IDS)
    saturation = 1.0 + size["saturation"] * random.uniform(-1.0, 1.0, IDS)
    brightness = 1.0 + size["brightness"] * random.uniform(-1.0, 1.0, IDS)
    # Colours are turned about the axis of greys, and drawn towards their brightness or away from it.
    cos, sin = np.cos(hue), np.sin(hue) / np.sqrt(3.0)
    mean = (1.0 - cos) / 3.0
    turn = np.empty((IDS, 3, 3))
    for row in range(3):
        turn[:, row, row] = cos + mean
        turn[:, row, (row + 1) % 3] = mean - sin
        turn[:, row, (row + 2) % 3] = mean + sin
    grey = np.broadcast_to(np.array(LUMA), (3, 3))
    keep = saturation[:, None, None]
    mixes = keep * np.eye(3) + (1.0 - keep) * grey
    mixes = brightness[:, None, None] * (mixes @ turn)
    # Segment 0 is what nothing is hit in.
    mixes[0] = np.eye(3)
    # As the kernel mixes in single precision.
    return mixes.astype(np.float32)


COLOURS = ColoursAxis()
