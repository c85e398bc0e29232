"""Leaving what was opened: nothing brakes the doors and drawers of ``joint_dynamics="published"``.

A link that still moves when the hand lets go moves on for seconds, and one that the arm touches on its way to rest is
pushed shut.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import numpy as np

from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import motion
from mjhab.experts.phases import phase
from mjhab.experts.planning import approach

Motion = motion.Motion
STILL_SPEED = 0.01
"""Largest closing speed of a link that may be let go [m/s or rad/s]; until the arm is at rest it moves by 2 % of its
range. One that still opens a little does no harm."""
LOOSEN_STEPS = 5
"""Control steps in which the fingers open slowly."""
STILL_STEPS = 12
"""Control steps for which the hand holds a handle until its link closes no more."""


@phase("wait until the link closes no more")
def settle(view: WorldView, link: JointedLink, gripper: float) -> Motion:
    """Stand still until a link that runs free closes no more, or for `STILL_STEPS` control steps."""
    if not view.links_run_free:
        return True

    def still(view: WorldView) -> bool:
        return view.link_speed(link.id) >= -STILL_SPEED

    return (yield from motion.hold(view, STILL_STEPS, gripper=gripper, until=still))


@phase("retract beside the open link")
def retract_beside(
    view: WorldView, link: JointedLink, enough: float, gripper: float
) -> Motion:
    """Bring the arm to rest beside an open link. Returns False as soon as the link is open by less than ``enough``."""
    for action in approach.retract(view, gripper=gripper):
        if view.link_q(link.id) < enough:
            return False
        yield action
    return view.link_q(link.id) >= enough


@phase("open the fingers slowly")
def loosen(view: WorldView, gripper: float) -> Motion:
    """Open the fingers slowly to a gripper command; the arm keeps its posture."""
    posture = view.q
    finger = float(view.q[view.robot.columns.fingers].mean())
    start = motion.gripper_at(view.robot, 2.0 * finger)
    for share in np.linspace(0.0, 1.0, LOOSEN_STEPS):
        # Slowest at the start, where the fingers still press.
        now = start + float(share) ** 2 * (gripper - start)
        yield motion.action(view, posture, gripper=now)
    return True
