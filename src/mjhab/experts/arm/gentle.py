"""Limits on the acceleration of the base while the gripper holds an object, so that the object does not slip.

The hand is almost a metre in front of the base. A sudden change of yaw rate can pull an object out of the fingers,
most easily an object whose centre of mass is far from the finger pads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.jit import kernel


class CommandLimits(NamedTuple):
    """Limits on the base commands.

    Attributes:
        rise: largest change of the forward speed per control step [m/s].
        change: largest change of the yaw rate per control step while its magnitude grows [rad/s].
        fall: largest change of the yaw rate per control step while its magnitude falls [rad/s].
        spin: largest yaw rate [rad/s].
    """

    rise: float
    change: float
    fall: float
    spin: float


FIRM = CommandLimits(0.12, 0.25, 0.25, 1.8)
WEAK = CommandLimits(0.12, 0.08, 0.16, 1.6)
BRISK = CommandLimits(0.12, 0.14, 0.2, 1.8)
WEAK_GRIP_KG_M = 0.02
"""Mass times distance between tcp and object position [kg m] above which a grasp counts as weak and `WEAK` or `BRISK`
limits apply. Measured: a box of 0.5 kg, grasped 51 mm off its centre, slips in a turn with `FIRM` and not with `WEAK`.
`BRISK` is the compromise for short time limits."""


def limits_for(view: WorldView, fast: bool = False) -> CommandLimits:
    """Choose the limits for the object nearest to the tcp.

    Args:
        view: the world.
        fast: use `BRISK` instead of `WEAK` for a weak grasp.
    """
    tcp = view.tcp_pose[:3]
    far = {
        name: float(np.linalg.norm(view.object_pose(name)[:3] - tcp))
        for name in view.object_names
    }
    if not far:
        return FIRM
    held = min(far, key=lambda name: far[name])
    if view.object_type(held).mass * far[held] <= WEAK_GRIP_KG_M:
        return FIRM
    return BRISK if fast else WEAK


@kernel
def eased(
    wish: tuple[float, float], before: tuple[float, float], limits: CommandLimits
) -> tuple[float, float]:
    """Limit the change of the base commands from one control step to the next.

    Args:
        wish: forward speed [m/s] and yaw rate [rad/s] that are wanted.
        before: those of the control step before.
        limits: limits.

    Returns:
        Forward speed [m/s] and yaw rate [rad/s].
    """
    forward = before[0] + min(max(wish[0] - before[0], -limits.rise), limits.rise)
    more = min(max(wish[1], -limits.spin), limits.spin) - before[1]
    change = limits.change if more * before[1] >= 0.0 else limits.fall
    return forward, before[1] + min(max(more, -change), change)
