"""Script that opens a hinged door: the hand follows the door's arc while the base drives along.

Lengths [m], angles [rad], world frame.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import functools

import numpy as np

from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import motion
from mjhab.experts.base.route import follow
from mjhab.experts.phases import phase
from mjhab.experts.planning import approach, link_motions, link_path
from mjhab.experts.planning.link_motions import LinkMotions
from mjhab.experts.planning.link_path import LinkPath
from mjhab.experts.skills import leaving
from mjhab.experts.skills.doors import motions
from mjhab.experts.skills.doors.arc import (
    ARC_STEPS,
    MAX_SWING_RAD,
    Hitch,
    arc_step,
    reachable,
)
from mjhab.experts.skills.doors.motions import OPEN_TO_SHARE
from mjhab.experts.style import style_of, wait_for

Motion = motion.Motion
AROUND_BAR_M = 0.045
"""Distance between the open fingers beyond the thickness of the bar that they close around; with the fingers wide open,
the inner finger would push the door."""
LET_GO_BAR_M = 0.03
"""Distance between the fingers beyond the thickness of the bar that they release."""
OPEN_ENOUGH_SHARE = 0.753
"""Share of the range from which on a door counts as open for the script; success requires 0.75."""
OPEN_SPARE_SHARE = 0.008
"""Share of the range by which a door is pulled beyond `OPEN_TO_SHARE`, so that a later contact does not close it below
what success requires."""
STILL_STEPS = 3
"""Control steps for which the hand holds the bar at the end, so that the door is at rest when the fingers open. Let go
while it still moved, the bar met a finger on the hand's way out and swung back; with these steps, and closed fingers on
the way to rest, 60 instead of 58 of 60 doors stayed open (split train)."""
PULL_STEP_RAD = 0.046
"""Largest motion of an arm joint per control step while the hand pulls the door open. More than when it is pushed: time
was what failed openings lacked."""
PULL_LEAD_RAD = 0.3
"""Largest angle of the hand's goal ahead of a door that is pulled."""
HALF_POINTS = 6
"""Way points of a pull that lets the door swing on from 0.93 rad, where a wall leaves no room for more. Of the doors
of `builtin_m3_20` (split val, seed 77) 38 of 40 opened; 7 of 16 with 7 points, none of 12 with 8: the wall stops the
hand on its way back, and the bar hits it."""
SWING_SPARE_RAD = 0.05
"""Angle before the end of its path at which the hand lets go of a door that swings on."""
LOST_SHARE = 0.9
"""Share of the goal below which a door that nothing touches is lost; beyond, it may swing on by itself."""
LOST_M = 0.06
"""Horizontal distance between hand and handle beyond which the hand has lost it."""


@phase("open the door", "pull")
def open_door(view: WorldView, link: JointedLink) -> Motion:
    """Open a hinged door: grasp the bar, follow its arc, release it, return to rest; again after a slip.

    A door that something brakes is held until it is at rest. One that runs free is let go of while it opens, and swings
    on to the end of its range: on the way the fingers come to hold a wide bar by its corners alone, turned by up to
    1.2 rad, and press it out as soon as the hand stands, which threw 9 of 60 doors shut (ReplicaCAD, split train).
    """
    enough = OPEN_ENOUGH_SHARE * link.range[1]
    # Motions are cached per value: rounding limits the number of searches over a continuous range of styles.
    further = round(style_of(view).open_further, 2)
    end = (OPEN_TO_SHARE + OPEN_SPARE_SHARE + further) * link.range[1]
    job = f"pull {further}" if further else "pull"
    search = functools.partial(motions.pull_motions, further=further)
    while view.steps_left > 40:
        # Looked at first: an earlier attempt, or another policy, may have opened it already.
        if leaving.stays_open(view, link, enough):
            if (yield from leaving.retract_beside(view, link, enough, motion.CLOSED)):
                return True
            # With the fingers closed on the bar, which keeps the door from falling shut.
            yield from leaving.settle(view, link, motion.CLOSED)
            continue
        found = link_motions.cached(view.robot, link, job, search)
        path = _way_open(view, link, found, motions.pull_angles(link, further))
        if path is None:
            return False
        around, loose = (
            motion.gripper_at(view.robot, link.handle.thickness + spare)
            for spare in (AROUND_BAR_M, LET_GO_BAR_M)
        )
        yield from follow(view, path.route, gripper=around)
        # The first way point is before the bar, the second one on it.
        rot = path.hand_at(path.values[1])[1]
        if (
            yield from approach.take(
                view, link, rot, path.q[1], height=path.height, gripper=around
            )
        ):
            yield from _pull_open(view, link, path, end)
        # A hand that held on would stop the door, or be pulled along.
        if leaving.swings(view, link):
            yield from leaving.swing_on(view, link)
            continue
        until = wait_for(view, motion.is_quiet)
        yield from motion.hold(view, STILL_STEPS, gripper=motion.CLOSED, until=until)
        yield from leaving.settle(view, link, motion.CLOSED)
        yield from approach.let_go(view, 0.12, gripper=loose)
    return (yield from approach.retract(view, gripper=motion.CLOSED))


def _way_open(
    view: WorldView, link: JointedLink, found: LinkMotions, angles: np.ndarray
) -> LinkPath | None:
    """The motion that opens a door, see `reachable`; its first half alone where a wall leaves no room for the hand at
    the end, and the door is free to swing on."""
    path = reachable(view, link, found, angles)
    # Only a free door swings on from the middle of its range; a braked one would stop there.
    if path is None and view.links_run_free:
        half = LinkMotions(found.q[:, :HALF_POINTS], found.steps, found.back)
        path = reachable(view, link, half, angles[:HALF_POINTS])
    return path


@phase("pull the door open", "pull")
def _pull_open(view: WorldView, link: JointedLink, path: LinkPath, goal: float) -> Motion:
    """Move the hand, which holds the bar, and the base along a path until the door is open by ``goal`` [rad], or swings
    and is open enough.

    Returns False when the hand loses the door, or the motion is stuck.
    """
    aim = float(path.values[1])
    # A path of half the way ends before the door is open enough, and its end counts then.
    end = float(path.values[-1])
    # At the end of its path the hand stands, and so does the door.
    enough = min(OPEN_ENOUGH_SHARE * link.range[1], end - SWING_SPARE_RAD)
    hitch = Hitch()
    for _ in range(ARC_STEPS):
        now = view.link_q(link.id)
        if now >= goal or (now >= enough and leaving.swings(view, link)):
            return True
        step = arc_step(path, aim, MAX_SWING_RAD, PULL_STEP_RAD)
        if aim - now < PULL_LEAD_RAD:
            aim = min(aim + step, end)
        if hitch.stops(view, aim == end) or (
            now < LOST_SHARE * goal and _has_lost(view, link)
        ):
            return False
        yield link_path.action(view, path, aim, step, motion.CLOSED)
    return False


def _has_lost(view: WorldView, link: JointedLink) -> bool:
    """Whether the fingers do not touch the handle and the tcp is beside it, measured horizontally."""
    # One finger is enough: the bar lies against one of the two while the door is pulled.
    if view.finger_forces(link.id).any():
        return False
    handle = link.handle_pose(view.link_q(link.id))[0]
    # Seen from above, because the hand may hold the upright bar at any height.
    return bool(np.linalg.norm(motion.tcp(view)[0][:2] - handle[:2]) > LOST_M)
