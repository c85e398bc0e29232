"""Leaving what was opened: nothing brakes the doors and drawers of ``joint_dynamics="published"``.

A link that still moves when the hand lets go moves on for seconds, and one that the arm touches on its way to rest is
pushed shut.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.phases import phase
from mjhab.experts.planning import approach

Motion = motion.Motion
STILL_SPEED = 0.01
"""Largest closing speed of a link that may be let go [m/s or rad/s]; until the arm is at rest it moves by 2 % of its
range. One that still opens a little does no harm."""
STILL_STEPS = 12
"""Control steps for which the hand holds a handle until its link closes no more."""
SWING_SPEED = 0.1
"""Opening speed of a free link from which on it opens by itself [m/s or rad/s]. A door of 1 kg m^2 with a friction of
0.01 N m and a damping of 0.01 N m s/rad (all three as published) opens by another 0.47 rad, a fifth of its range."""
SWING_STEPS = 14
"""Control steps in which the fingers get past the handle of a swinging door."""
BACK_SPEED_M_S = 0.7
"""Speed of the fingers on their way past the handle. With 0.5, 0.6 and 0.7 m/s 35, 34 and 38 of 40 doors opened that
are let go of at 0.93 rad (`builtin_m3_20`), where the bar comes after the hand."""
PAST_BAR_M = 0.07
"""Distance from the middle of a handle to the fingertips at which they are past it. The corners of the widest bar
(ReplicaCAD's fridge, 0.050 x 0.071 m) are 0.043 m from its middle."""


def swings(view: WorldView, link: JointedLink) -> bool:
    """Whether a link opens, and nothing brakes it."""
    return view.links_run_free and view.link_speed(link.id) > SWING_SPEED


def stays_open(view: WorldView, link: JointedLink, enough: float) -> bool:
    """Whether a link is open by ``enough`` [m or rad], or swings on until it is."""
    return view.link_q(link.id) >= enough or swings(view, link)


@phase("wait until the link closes no more", "hold")
def settle(view: WorldView, link: JointedLink, gripper: float) -> Motion:
    """Stand still until a link that runs free closes no more, or for `STILL_STEPS` control steps."""
    if not view.links_run_free:
        return True

    def still(view: WorldView) -> bool:
        return view.link_speed(link.id) >= -STILL_SPEED

    return (yield from motion.hold(view, STILL_STEPS, gripper=gripper, until=still))


@phase("retract beside the open link", "retract")
def retract_beside(
    view: WorldView, link: JointedLink, enough: float, gripper: float
) -> Motion:
    """Bring the arm to rest beside an open link. Returns False as soon as it does not stay open by ``enough``."""
    # Looked at in every step: the earlier a touch is noticed, the less the link has closed.
    for action in approach.retract(view, gripper=gripper):
        if not stays_open(view, link, enough):
            return False
        yield action
    return stays_open(view, link, enough)


@phase("let the door swing on", "release")
def swing_on(view: WorldView, link: JointedLink) -> Motion:
    """Open the fingers around the bar of a door that swings open, and draw them back while they keep pace with the bar.

    Fingers that stood still would be hit by the bar and throw the door back. Returns whether they are past the bar.
    """
    pos, rot = motion.tcp(view)
    # The hand may hold the bar off its middle, and must keep to that place while it backs off.
    offset = pos - link.handle_pose(view.link_q(link.id))[0]
    posture = view.q
    dofs = ik.columns(view.robot.chain)
    # The base helps only backwards: the way out may lead across its heading.
    along = float(-rot[:2, 0] @ motion.ahead(view.base[2]))
    drive = (BACK_SPEED_M_S * min(along, 0.0), 0.0)
    past = view.robot.gripper.finger[0] + PAST_BAR_M
    for step in range(SWING_STEPS):
        now = view.link_q(link.id)
        bar = link.handle_pose(now)[0]
        if float((bar - motion.tcp(view)[0])[:2] @ rot[:2, 0]) > past:
            return True
        swing = max(view.link_speed(link.id), 0.0) * STEP_SECONDS
        back = BACK_SPEED_M_S * STEP_SECONDS * (step + 1)
        # Where the bar will be after this control step: aiming at where it is now, the hand lags by one.
        goal = link.handle_pose(now + swing)[0] + offset - back * rot[:, 0]
        aim = ik.TipGoals(goal[None], rot[None], dofs, posture)
        yield motion.hand_action(view, aim, gripper=motion.OPEN, drive=drive)
    return False
