"""Limits on the commands of the base, so that it does not swing out and an object in the gripper does not slip.

The hand is almost a metre in front of the base. A sudden change of yaw rate can pull an object out of the fingers,
most easily an object whose centre of mass is far from the finger pads.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.jit import kernel

MAX_SPEED_M_S = 1.0
"""Largest forward speed: what an action of 1 commands (`Robot.limits.forward`)."""
MAX_YAW_RATE_RAD_S = 2.6
"""Largest yaw rate, below the 3.14 rad/s of an action of 1."""
WEAK_GRIP_KG_M = 0.02
"""Mass times distance between tcp and object position [kg m] above which a grasp counts as weak and `WEAK` or
`WEAK_FAST` limits apply. Measured: a box of 0.5 kg, grasped 51 mm off its centre, slips in a turn with `FIRM` and not
with `WEAK`."""


class CommandLimits(NamedTuple):
    """Limits on the base commands from one control step to the next.

    Attributes:
        rise: largest increase of the forward speed [m/s].
        brake: largest decrease of the forward speed [m/s].
        change: largest change of the yaw rate while its magnitude grows [rad/s].
        fall: largest change of the yaw rate while its magnitude falls [rad/s].
        spin: largest yaw rate [rad/s].
        turn: factor on the yaw rate with which the follower steers.
        speed: largest forward speed [m/s].
    """

    rise: float
    brake: float
    change: float
    fall: float
    spin: float
    turn: float = 1.0
    speed: float = MAX_SPEED_M_S


UNLIMITED = CommandLimits(np.inf, np.inf, np.inf, np.inf, MAX_YAW_RATE_RAD_S)
"""For an empty hand on the short routes of Pick and Place, where time is short."""
FIRM = CommandLimits(0.12, 0.12, 0.25, 0.25, 1.8)
WEAK = CommandLimits(0.12, 0.12, 0.08, 0.16, 1.6)
WEAK_FAST = CommandLimits(0.12, 0.12, 0.14, 0.2, 1.8)
"""For a held object: a firm grip, a weak one (`WEAK_GRIP_KG_M`), and a compromise for short time limits."""
DRIVE_FREE = CommandLimits(
    20.0 * STEP_SECONDS,
    40.0 * STEP_SECONDS,
    80.0 * STEP_SECONDS,
    80.0 * STEP_SECONDS,
    2.6,
)
DRIVE_HELD = CommandLimits(
    1.5 * STEP_SECONDS,
    3.0 * STEP_SECONDS,
    3.0 * STEP_SECONDS,
    3.0 * STEP_SECONDS,
    1.2,
    turn=0.5,
    speed=0.7,
)
"""For Navigate, which has more time: with an empty hand, and with an object that must not slip on a long drive (rates
in m/s2 and rad/s2 times the control period)."""


def limits_for(view: WorldView, fast: bool = False) -> CommandLimits:
    """Choose the limits for the object nearest to the tcp.

    Args:
        view: the world.
        fast: use `WEAK_FAST` instead of `WEAK` for a weak grasp.
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
    return WEAK_FAST if fast else WEAK


@kernel
def eased(
    wish: tuple[float, float], before: tuple[float, float], limits: CommandLimits
) -> tuple[float, float]:
    """Limit the change of the base commands from one control step to the next.

    Args:
        wish: forward speed [m/s] and yaw rate [rad/s] that are wanted.
        before: those of the control step before.
        limits: largest changes and values.

    Returns:
        Forward speed [m/s] and yaw rate [rad/s].
    """
    rise = limits.rise if (wish[0] - before[0]) * before[0] >= 0.0 else limits.brake
    forward = min(max(wish[0], before[0] - rise), before[0] + rise)
    turn = min(max(wish[1], -limits.spin), limits.spin)
    change = limits.change if (turn - before[1]) * before[1] >= 0.0 else limits.fall
    return forward, min(max(turn, before[1] - change), before[1] + change)
