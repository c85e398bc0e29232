"""Script that closes a hinged door: the hand pushes it along its arc while the base drives along.

Lengths [m], angles [rad], world frame. Letters: K way points of a motion.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import numpy as np

from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.base.route import follow
from mjhab.experts.phases import phase
from mjhab.experts.planning import approach, link_motions, link_path
from mjhab.experts.planning.link_motions import LinkMotions
from mjhab.experts.planning.link_path import LinkPath
from mjhab.experts.skills.doors import motions
from mjhab.experts.skills.doors.arc import (
    AJAR_SHARE,
    ARC_STEPS,
    AT_REST_RAD,
    COAST_SPARE_RAD,
    MAX_SWING_RAD,
    PRESS_STEPS,
    Hitch,
    arc_step,
    coasts,
    reachable,
)
from mjhab.experts.skills.doors.motions import HALF_OPEN_SHARE, PRESS_AHEAD_RAD
from mjhab.experts.skills.doors.sweeping import sweep
from mjhab.experts.style import style_of
from mjhab.robots.robot import Robot
from mjhab.tasks.style import PUSH, SWEEP

Motion = motion.Motion
SHUT_SHARE = 0.006
"""Share of the range to which a door is pressed shut; success requires 0.01."""
IN_LINE_M = 0.025
"""Distance of the hand beside its straight line behind the door up to which it moves forward at full speed."""
ENTERED_M = 0.04
"""Distance from the end of that line at which the hand has arrived."""
STRUCK_RAD = 0.15
"""Angle by which the approach may push the door open; beyond it, the approach is planned again."""
ENTER_STEP_M = 0.04
"""Motion of the hand per control step on the line behind the door."""
ENTER_STEPS = 22
"""Greatest number of control steps on the line behind the door."""
BEHIND_WAY_M = 0.25
"""Length of the straight line of the hand behind an open door."""
JOINT_STEP_RAD = 0.037
"""Largest motion of an arm joint per control step while the hand pushes the door, which should not leave it."""
PUSH_STEP_RAD = 0.02, 0.045
"""Change of the commanded angle per control step of a door that is pushed all the way: a constant, and an addition per
radian that it is open. A slow door does not leave the hand."""
PUSH_LEAD_RAD = 0.15
"""Largest angle of the hand's goal ahead of a door that is pushed, in addition to `PRESS_AHEAD_RAD`."""


@phase("close the door")
def close_door(view: WorldView, link: JointedLink) -> Motion:
    """Close a hinged door: reach behind it and accelerate it along its arc, then retract the arm while it swings shut.

    With the style ``close=push`` the hand pushes the door all the way. Both are repeated while the door is ajar. With
    ``close=sweep`` the base drives against the door with the arm at rest, where there is room for it.
    """
    if style_of(view).close == SWEEP:
        yield from sweep(view, link)
    throws = style_of(view).close != PUSH
    while view.steps_left > 40 and view.link_q(link.id) > AJAR_SHARE * link.range[1]:
        start = view.link_q(link.id) + PRESS_AHEAD_RAD
        half = start < HALF_OPEN_SHARE * link.range[1]
        search = motions.push_half_open if half else motions.push_open
        angles = motions.push_angles(link, half)
        found, angles = _from_angle(
            view.robot,
            link_motions.cached(view.robot, link, search.__name__, search),
            angles,
            min(start, angles[0]),
        )
        path = reachable(view, link, found, angles, BEHIND_WAY_M)
        if path is None:
            return False
        yield from follow(view, path.route, gripper=motion.CLOSED)
        # The approach pushed the door open: the path begins where the door is no longer.
        if view.link_q(link.id) > start - PRESS_AHEAD_RAD + STRUCK_RAD:
            continue
        yield from _behind_edge(view, path)
        while (
            yield from _push_shut(view, link, path, SHUT_SHARE * link.range[1], throws)
        ):
            if (yield from _leave_swinging(view, link)):
                break
        else:
            yield from approach.retreat(view, 0.06)
    return (yield from approach.retract(view))


@phase("push the door shut")
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
        if now - aim < PRESS_AHEAD_RAD + PUSH_LEAD_RAD:
            aim = max(aim - step, end)
        if hitch.stops(view, aim == end):
            return False
        yield link_path.action(view, path, aim, -step, motion.CLOSED)
    return False


@phase("retract while the door swings shut")
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


@phase("reach behind the door")
def _behind_edge(view: WorldView, path: LinkPath) -> Motion:
    """Move the hand straight along its axis to the beginning of a path, behind the edge of an open door.

    The hand moves forward only while it is close to its line: with an error of the base pose it would hit the edge.
    Returns whether it arrived.
    """
    robot = view.robot.chain
    wish = path.q[0]
    pos, rot = path.hand_at(float(path.values[0]))
    for _ in range(ENTER_STEPS):
        here, turn = motion.tcp(view)
        back = float((pos - here) @ rot[:, 0])
        aside = pos - here - back * rot[:, 0]
        off = float(np.linalg.norm(aside))
        if back < ENTERED_M:
            return True
        ahead = min(back, ENTER_STEP_M) * float(np.clip(2.0 - off / IN_LINE_M, 0.0, 1.0))
        goal = here + ahead * rot[:, 0] + min(1.0, ENTER_STEP_M / max(off, 1e-9)) * aside
        aim_rot = ik.straight_line(
            here[None], pos[None], turn[None], rot[None], 1.0, 0.1
        )[1]
        yield motion.hand_action(
            view,
            ik.TipGoals(goal[None], aim_rot, ik.columns(robot), wish, "approach"),
            gripper=motion.CLOSED,
            drive=approach.base_towards(view, wish),
            rest_gain=0.1,
        )
    return False


def _from_angle(
    body: Robot, found: LinkMotions, angles: np.ndarray, start: float
) -> tuple[LinkMotions, np.ndarray]:
    """Cut closing motions so that they start at the door angle ``start``; returns them and their angles."""
    k = int(np.searchsorted(-angles, -start))
    if k == 0:
        return found, angles
    share = (angles[k - 1] - start) / (angles[k - 1] - angles[k])
    first = (1.0 - share) * found.q[:, k - 1] + share * found.q[:, k]
    robot = body.chain
    steps = ik.travel_steps(robot, body.rest, first, ik.columns(robot))
    q = np.concatenate([first[:, None], found.q[:, k:]], axis=1)
    return LinkMotions(q, steps, found.back), np.append(start, angles[k:])
