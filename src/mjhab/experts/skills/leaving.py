"""Leaving what was opened: nothing brakes the doors and drawers of ``joint_dynamics="published"``.

A link that still moves when the hand lets go moves on for seconds, and one that the arm touches on its way to rest is
pushed shut.
"""

from __future__ import annotations

from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import motion
from mjhab.experts.planning import approach

Motion = motion.Motion
STILL_SPEED = 0.01
"""Largest closing speed of a link that may be let go [m/s or rad/s]; until the arm is at rest it moves by 2 % of its
range. One that still opens a little does no harm."""
STILL_STEPS = 12
"""Control steps for which the hand holds a handle until its link closes no more."""


def settle(view: WorldView, link: JointedLink, gripper: float) -> Motion:
    """Stand still until a link closes no more, or for `STILL_STEPS` control steps."""

    def still(view: WorldView) -> bool:
        return view.link_speed(link.id) >= -STILL_SPEED

    return (yield from motion.hold(view, STILL_STEPS, gripper=gripper, until=still))


def fold_beside(
    view: WorldView, link: JointedLink, enough: float, gripper: float
) -> Motion:
    """Bring the arm to rest beside an open link. Returns False as soon as the link is open by less than ``enough``."""
    for action in approach.fold(view, gripper=gripper):
        if view.link_q(link.id) < enough:
            return False
        yield action
    return view.link_q(link.id) >= enough
