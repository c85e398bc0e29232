"""Script that closes a hinged door: the hand pushes it along its arc while the base drives along.

Lengths [m], angles [rad], world frame. Letters: K way points of a motion.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import numpy as np

from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import motion
from mjhab.experts.base.route import follow
from mjhab.experts.phases import phase
from mjhab.experts.planning import approach, link_motions, link_path
from mjhab.experts.planning.link_path import LinkPath
from mjhab.experts.skills.doors import beside_wall, motions
from mjhab.experts.skills.doors.arc import (
    AJAR_SHARE,
    ARC_STEPS,
    AT_REST_RAD,
    COAST_SPARE_RAD,
    MAX_SWING_RAD,
    PRESS_STEPS,
    HandEntry,
    Hitch,
    arc_step,
    coasts,
    from_angle,
    reachable,
    straight_in,
)
from mjhab.experts.skills.doors.motions import HALF_OPEN_SHARE, PRESS_AHEAD_RAD
from mjhab.experts.skills.doors.sweeping import sweep
from mjhab.experts.style import style_of
from mjhab.tasks.style import PUSH, SWEEP

Motion = motion.Motion
SHUT_SHARE = 0.006
"""Share of the range to which a door is pressed shut; success requires 0.01."""
STRUCK_RAD = 0.15
"""Angle by which the approach may push the door open; beyond it, the approach is planned again."""
BEHIND_WAY_M = 0.25
"""Length of the straight line of the hand behind an open door."""
ENTRY = HandEntry(in_line=0.025, entered=0.04, steps=22)
"""The hand's motion on this line."""
JOINT_STEP_RAD = 0.037
"""Largest motion of an arm joint per control step while the hand pushes the door, which should not leave it."""
PUSH_STEP_RAD = 0.02, 0.045
"""Change of the commanded angle per control step of a door that is pushed all the way: a constant, and an addition per
radian that it is open. A slow door does not leave the hand."""
PUSH_LEAD_RAD = 0.15
"""Largest angle of the hand's goal ahead of a door that is pushed, in addition to `PRESS_AHEAD_RAD`."""


@phase("close the door", "approach")
def close_door(view: WorldView, link: JointedLink) -> Motion:
    """Close a hinged door: reach behind it and accelerate it along its arc, then retract the arm while it swings shut.

    Where no ordinary motion is free, as at a wall, the hand pulls the edge of the door out (`beside_wall`).
    With the style ``close=push`` the hand pushes the door all the way. Both are repeated while the door is ajar. With
    ``close=sweep`` the base drives against the door with the arm at rest, where there is room for it.
    """
    # A sweep that fails leaves the door partly open, from where the hand goes on.
    if style_of(view).close == SWEEP:
        yield from sweep(view, link)
    throws = style_of(view).close != PUSH
    # In less time than this no motion ends with the arm at rest, and another attempt would leave the hand at the door.
    while view.steps_left > 40 and view.link_q(link.id) > AJAR_SHARE * link.range[1]:
        now = view.link_q(link.id)
        path, enter = from_outside(view, link), _reach_behind
        if path is None:
            path, enter = beside_wall.from_edge(view, link), beside_wall.reach_past
        if path is None:
            return False
        yield from follow(view, path.route, gripper=motion.CLOSED)
        # The approach pushed the door open: the path begins where the door is no longer.
        if view.link_q(link.id) > now + STRUCK_RAD:
            continue
        yield from enter(view, path)
        while (
            yield from _push_shut(view, link, path, SHUT_SHARE * link.range[1], throws)
        ):
            if (yield from _leave_swinging(view, link)):
                break
        else:
            yield from approach.retreat(view, 0.06)
    return (yield from approach.retract(view))


def from_outside(view: WorldView, link: JointedLink) -> LinkPath | None:
    """The motion that pushes a door shut from its outside, where there is room for the hand; None if there is none."""
    start = view.link_q(link.id) + PRESS_AHEAD_RAD
    half = start < HALF_OPEN_SHARE * link.range[1]
    search = motions.push_half_open if half else motions.push_open
    angles = motions.push_angles(link, half)
    found = link_motions.cached(view.robot, link, search.__name__, search)
    return reachable(
        view, link, *from_angle(view.robot, found, angles, start), BEHIND_WAY_M
    )


@phase("reach behind the door", "approach")
def _reach_behind(view: WorldView, path: LinkPath) -> Motion:
    """Move the hand in a straight line behind an open door. Returns whether it arrived."""
    return (yield from straight_in(view, path, ENTRY))


@phase("push the door shut", "push")
def _push_shut(
    view: WorldView, link: JointedLink, path: LinkPath, goal: float, throws: bool
) -> Motion:
    """Move the hand, which is behind the door, and the base along a path until the door is shut.

    Args:
        view: the world.
        link: the door.
        path: configurations along the door's arc.
        goal: angle at which the door counts as shut [rad].
        throws: end as soon as the released door would swing shut by itself.

    Returns:
        Whether the door is shut and at rest, or will be; False when the motion is stuck.
    """
    aim = min(float(path.values[0]), view.link_q(link.id) + PRESS_AHEAD_RAD)
    end = float(path.values[-1])
    hitch = Hitch()
    # No speed is known in the first step: it must not count as a door at rest.
    last = np.inf
    shut = 0
    for _ in range(ARC_STEPS):
        now = view.link_q(link.id)
        speed = style_of(view).speed * (last - now) / STEP_SECONDS
        if throws and coasts(speed) > now + COAST_SPARE_RAD:
            return True
        # A door that is shut but moves may bounce open again.
        shut = shut + 1 if now <= goal and abs(now - last) < AT_REST_RAD else 0
        last = now
        if shut > PRESS_STEPS:
            return True
        step = arc_step(path, aim, -MAX_SWING_RAD, JOINT_STEP_RAD)
        if not throws:
            step = min(step, PUSH_STEP_RAD[0] + PUSH_STEP_RAD[1] * max(now, 0.0))
        # A goal that ran away from a door that is held up would strike it once it is free.
        if now - aim < PRESS_AHEAD_RAD + PUSH_LEAD_RAD:
            aim = max(aim - step, end)
        if hitch.stops(view, aim == end):
            return False
        yield link_path.action(view, path, aim, -step, motion.CLOSED)
    return False


@phase("retract while the door swings shut", "retract")
def _leave_swinging(view: WorldView, link: JointedLink) -> Motion:
    """Retract the arm while a released door swings shut. Returns False when the door comes to rest ajar."""
    last = np.inf
    for action in approach.retract(view, shut=link, gripper=motion.CLOSED):
        now = view.link_q(link.id)
        if now > AJAR_SHARE * link.range[1] and abs(now - last) < AT_REST_RAD:
            return False
        last = now
        yield action
    return True
