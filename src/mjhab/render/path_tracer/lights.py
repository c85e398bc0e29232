"""What shines in a traced home: sky and sun, lamps; how bright its pictures are exposed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mjhab.render.path_tracer.windows import Opening
from mjhab.scenes.shading import EVENING, MIDDAY

LAMP_RADIUS_M = 0.09
SKY_SIZE = (32, 64)
"""Height and width of the picture of the sky [px]."""
_ROUND = 4.0 / LAMP_RADIUS_M**2
"""Radiance of a ball that shines on what is 2 m off like a flat source of irradiance pi."""


@dataclass(frozen=True)
class Daylight:
    """A time of day. Radiances are linear rgb.

    Attributes:
        zenith, horizon, ground: radiance of the sky above and at the horizon, and of what is below it.
        sun: irradiance of the sun on a surface that faces it; all 0: it has set.
        to_sun: unit direction to it.
        lamp: radiance of a lamp whose irradiance is 1 at 2 m, times this factor; colour of the bulb.
        exposure: factor on the radiance of pictures in rooms; open: of those from above, without ceiling.
    """

    zenith: tuple[float, float, float]
    horizon: tuple[float, float, float]
    ground: tuple[float, float, float]
    sun: tuple[float, float, float]
    to_sun: tuple[float, float, float]
    lamp: tuple[float, float, float]
    exposure: float
    open: float

    @property
    def sunny(self) -> bool:
        """Whether the sun is up."""
        return any(self.sun)


TIMES = {
    MIDDAY: Daylight(
        (3.2, 5.2, 8.5),
        (8.4, 8.6, 8.8),
        (2.2, 2.3, 2.0),
        (26.0, 24.0, 20.0),
        (0.44, 0.62, 0.65),
        (0.62, 0.59, 0.54),
        2.4,
        0.11,
    ),
    EVENING: Daylight(
        (0.02, 0.035, 0.09),
        (0.16, 0.10, 0.09),
        (0.012, 0.012, 0.014),
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 1.0),
        (1.0, 0.76, 0.5),
        1.75,
        1.4,
    ),
}


def sky(mi: Any, light: Daylight) -> dict[str, Any]:
    """The sky and what lies below the horizon, as an emitter."""
    height, width = SKY_SIZE
    # Row 0 is straight up.
    up = np.cos((np.arange(height) + 0.5) / height * np.pi)
    # The square root: most of the change of a clear sky is near the horizon.
    share = np.clip(up, 0.0, 1.0)[:, None] ** 0.5
    above = np.array(light.horizon) + share * np.subtract(light.zenith, light.horizon)
    rows = np.where(up[:, None] > 0.0, above, np.array(light.ground))
    picture = np.repeat(rows[:, None], width, axis=1).astype(np.float32)
    # The axis of Mitsuba's sky is +y; ours is +z.
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"type": "envmap", "bitmap": mi.Bitmap(picture), "to_world": turn}


def daylight(mi: Any, light: Daylight, opening: Opening) -> dict[str, Any]:
    """The sky in an opening, as a pane that shines into the room: paths find it, as they would not find the sky."""
    place = np.eye(4)
    # A rectangle shines to the side of the cross product of its edges.
    turned = np.cross(opening.across, opening.up) @ opening.inward < 0.0
    place[:3, 0] = -opening.across if turned else opening.across
    place[:3, 1] = opening.up
    place[:3, 2] = opening.inward
    place[:3, 3] = opening.middle
    # Of the sky at the horizon, which is what windows show; the blue of the zenith would tint rooms.
    radiance = opening.clear * np.array(light.horizon)
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(place),
        "emitter": {
            "type": "area",
            "radiance": {"type": "rgb", "value": radiance.tolist()},
        },
    }


def sun(light: Daylight) -> dict[str, Any]:
    """The sun as an emitter."""
    return {
        "type": "directional",
        "direction": [-x for x in light.to_sun],
        "irradiance": {"type": "rgb", "value": list(light.sun)},
    }


def lamp(light: Daylight, pos: np.ndarray, color: np.ndarray) -> dict[str, Any]:
    """A ball that shines, at (3,) [m], of the colour (3,) that the home gives it."""
    radiance = _ROUND * np.array(light.lamp) * color / np.pi
    return {
        "type": "sphere",
        "center": pos.tolist(),
        "radius": LAMP_RADIUS_M,
        "emitter": {
            "type": "area",
            "radiance": {"type": "rgb", "value": radiance.tolist()},
        },
    }
