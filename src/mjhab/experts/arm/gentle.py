"""How gently the base drives with an object in the hand, so that it does not slip.

The hand is almost a metre before the base: a sudden turn pulls objects out of it, above all those whose weight is far
from the pads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.jit import kernel


class Care(NamedTuple):
    """Change of speed [m/s] and of yaw rate [rad/s] per control step, that of a yaw rate which falls, and the largest
    yaw rate."""

    rise: float
    change: float
    fall: float
    spin: float


FIRM = Care(0.12, 0.25, 0.25, 1.8)
WEAK = Care(0.12, 0.08, 0.16, 1.6)
BRISK = Care(0.12, 0.14, 0.2, 1.8)
WEAK_GRIP_KG_M = 0.02
"""Mass times distance from the pads from which on the grip is weak. A sugar box of half a kilogram, held by a
corner 51 mm off its centre, was lost in the first steps of a turn with `FIRM` and kept with `WEAK`. `BRISK` is a
compromise for when time is short."""


def care_for(view: WorldView, hurry: bool = False) -> Care:
    """Limits for the object nearest to the hand; looser ones if ``hurry``."""
    tcp = view.tcp_pose[:3]
    far = {
        name: float(np.linalg.norm(view.object_pose(name)[:3] - tcp)) for name in view.object_names
    }
    if not far:
        return FIRM
    held = min(far, key=lambda name: far[name])
    if view.object_type(held).mass * far[held] <= WEAK_GRIP_KG_M:
        return FIRM
    return BRISK if hurry else WEAK


@kernel
def eased(
    wish: tuple[float, float], before: tuple[float, float], care: Care
) -> tuple[float, float]:
    """Forward speed and yaw rate that are not far from those of the control step before."""
    forward = before[0] + min(max(wish[0] - before[0], -care.rise), care.rise)
    more = min(max(wish[1], -care.spin), care.spin) - before[1]
    change = care.change if more * before[1] >= 0.0 else care.fall
    return forward, before[1] + min(max(more, -change), change)
