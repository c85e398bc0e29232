"""Scripts that open and close a hinged door: the hand follows the door's arc while the base drives along.

Lengths [m], angles [rad], world frame. Letters: K way points of a motion, N and M configurations, J joints.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.joints import BASE
from mjhab.core.rotations import wrap
from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.base.route import follow
from mjhab.experts.phases import phase
from mjhab.experts.planning import approach, link_motions, link_path
from mjhab.experts.planning.link_motions import Frame, LinkMotions
from mjhab.experts.planning.link_path import LinkPath
from mjhab.experts.skills import door_motions, leaving
from mjhab.experts.skills.door_motions import (
    HALF_OPEN_SHARE,
    OPEN_TO_SHARE,
    PRESS_AHEAD_RAD,
    SWEEP_SPEED_M_S,
)
from mjhab.experts.style import style_of, wait_for
from mjhab.robots.robot import Robot
from mjhab.tasks.style import PUSH, SWEEP

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
WIDE_BAR_M = 0.035
"""Thickness from which on only the fingertips hold a bar: the last of them to leave it would throw a free door."""
STILL_STEPS = 3
"""Control steps for which the hand holds the bar at the end, so that the door is at rest when the fingers open. Let go
while it still moved, the bar met a finger on the hand's way out and swung back; with these steps, and closed fingers on
the way to rest, 60 instead of 58 of 60 doors stayed open (split train)."""
SHUT_SHARE = 0.006
"""Share of the range to which a door is pressed shut; success requires 0.01."""
AJAR_SHARE = 0.009
"""Share of the range above which a door is pushed again."""
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
MOTIONS_TRIED = 16
"""Number of motions whose clearance is checked."""
JOINT_STEP_RAD = 0.037
"""Largest motion of an arm joint per control step while the hand pushes the door, which should not leave it."""
PULL_STEP_RAD = 0.046
"""Largest motion of an arm joint per control step while the hand pulls the door open. More than `JOINT_STEP_RAD`: time
was what failed openings lacked."""
MAX_SWING_RAD = 0.045
"""Largest change of the commanded door angle per control step."""
PUSH_STEP_RAD = 0.02, 0.045
"""Change of the commanded angle per control step of a door that is pushed all the way: a constant, and an addition per
radian that it is open. A slow door does not leave the hand."""
MAX_LAG_STEPS = 12
"""Control steps for which the door may lag behind the end of the path before the motion gives up."""
COAST_TIME_S = 1.4
"""A released door decelerates by (speed + COAST_STOP_RAD_S) / COAST_TIME_S. Both constants follow from inertia, damping
and friction ("ours") of the doors of the built-in homes, and predict how far a released door swings. With the published
damping and friction it swings on until it is shut, and is released later than it could be."""
COAST_STOP_RAD_S = 0.5
"""See `COAST_TIME_S`."""
COAST_SPARE_RAD = 0.1
"""A door is released when it will swing this much farther than needed; a much faster door bounces open again."""
AT_REST_RAD = 0.002
"""Largest motion per control step of a door at rest."""
PRESS_STEPS = 2
"""Control steps for which a closed door must be at rest."""
JAMMED_FORCE_N = 300.0
JAMMED_STEPS = 2
"""Sum of the contact forces on the robot's links with which a motion is given up after so many more control steps."""
ARC_STEPS = 110
"""Control steps after which a motion along the arc is given up: little more than half of a subtask's."""
PULL_LEAD_RAD = 0.3
"""Largest angle of the hand's goal ahead of a door that is pulled."""
PUSH_LEAD_RAD = 0.15
"""The same for a door that is pushed, in addition to `PRESS_AHEAD_RAD`."""
LOST_SHARE = 0.9
"""Share of the goal below which a door that nothing touches is lost; beyond, it may swing on by itself."""
LOST_M = 0.06
"""Horizontal distance between hand and handle beyond which the hand has lost it."""

SWEEP_STEPS = 100
"""Greatest number of control steps of a sweep."""
SWEPT_M = 0.02
"""Distance from the end of a sweep at which the base has arrived."""


@phase("open the door")
def open_door(view: WorldView, link: JointedLink) -> Motion:
    """Open a hinged door: grasp the bar, follow its arc, release it, return to rest; again after a slip."""
    enough = OPEN_ENOUGH_SHARE * link.range[1]
    # Motions are cached per value: rounding limits the number of searches over a continuous range of styles.
    further = round(style_of(view).open_further, 2)
    end = (OPEN_TO_SHARE + OPEN_SPARE_SHARE + further) * link.range[1]
    job = f"pull {further}" if further else "pull"
    search = functools.partial(door_motions.pull_motions, further=further)
    while view.steps_left > 40:
        if view.link_q(link.id) >= enough:
            if (yield from leaving.retract_beside(view, link, enough, motion.CLOSED)):
                return True
            yield from leaving.settle(view, link, motion.CLOSED)
            continue
        found = link_motions.cached(view.robot, link, job, search)
        path = _reachable(view, link, found, door_motions.pull_angles(link, further))
        if path is None:
            return False
        around, loose = (
            motion.gripper_at(view.robot, link.handle.thickness + spare)
            for spare in (AROUND_BAR_M, LET_GO_BAR_M)
        )
        yield from follow(view, path.route, gripper=around)
        rot = path.hand_at(path.values[1])[1]
        if (
            yield from approach.take(
                view, link, rot, path.q[1], height=path.height, gripper=around
            )
        ):
            yield from _pull_open(view, link, path, end)
        until = wait_for(view, motion.is_quiet)
        yield from motion.hold(view, STILL_STEPS, gripper=motion.CLOSED, until=until)
        yield from leaving.settle(view, link, motion.CLOSED)
        if view.links_run_free and link.handle.thickness > WIDE_BAR_M:
            yield from leaving.loosen(view, loose)
        yield from approach.let_go(view, 0.12, gripper=loose)
    return (yield from approach.retract(view, gripper=motion.CLOSED))


@phase("close the door")
def close_door(view: WorldView, link: JointedLink) -> Motion:
    """Close a hinged door: reach behind it and accelerate it along its arc, then retract the arm while it swings shut.

    With the style ``close=push`` the hand pushes the door all the way. Both are repeated while the door is ajar. With
    ``close=sweep`` the base drives against the door with the arm at rest, where there is room for it.
    """
    if style_of(view).close == SWEEP:
        yield from _sweep(view, link)
    throws = style_of(view).close != PUSH
    while view.steps_left > 40 and view.link_q(link.id) > AJAR_SHARE * link.range[1]:
        start = view.link_q(link.id) + PRESS_AHEAD_RAD
        half = start < HALF_OPEN_SHARE * link.range[1]
        search = door_motions.push_half_open if half else door_motions.push_open
        angles = door_motions.push_angles(link, half)
        found, angles = _from_angle(
            view.robot,
            link_motions.cached(view.robot, link, search.__name__, search),
            angles,
            min(start, angles[0]),
        )
        path = _reachable(view, link, found, angles, BEHIND_WAY_M)
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


@phase("sweep the door shut with the base")
def _sweep(view: WorldView, link: JointedLink) -> Motion:
    """Drive to the outside of an open door and push it shut with the arm at rest, in a straight line.

    Returns whether the door is shut.
    """
    # Motions are cached per angle: rounding up limits the number of searches.
    angle = float(np.ceil(10.0 * view.link_q(link.id))) / 10.0
    search = functools.partial(door_motions.sweeps, angle=angle)
    found = link_motions.cached(view.robot, link, f"sweep {angle:.1f}", search)
    path = _reachable(view, link, found, np.linspace(1.0, 0.0, door_motions.SWEEP_POINTS))
    if path is None:
        return False
    yield from follow(view, path.route, gripper=motion.OPEN)
    end = path.q[-1]
    last = view.link_q(link.id)
    still = 0
    for _ in range(SWEEP_STEPS):
        now = view.link_q(link.id)
        speed = style_of(view).speed * (last - now) / STEP_SECONDS
        still = still + 1 if abs(now - last) < AT_REST_RAD else 0
        last = now
        left = end[:2] - view.base[:2]
        ahead = float(left @ motion.ahead(end[2]))
        shut = now < AJAR_SHARE * link.range[1]
        if still > PRESS_STEPS and (shut or ahead < SWEPT_M):
            break
        drive = 0.0
        if not shut and _coasts(speed) < now + COAST_SPARE_RAD:
            drive = min(SWEEP_SPEED_M_S, 0.2 + 0.35 * now, 3.0 * max(ahead, 0.0))
        aim = np.arctan2(left[1], left[0]) if ahead > 0.4 else end[2]
        turn = float(np.clip(3.0 * wrap(aim - view.base[2]), -0.6, 0.6))
        yield motion.action(
            view, motion.rest_goal(view), gripper=motion.OPEN, drive=(drive, turn)
        )
    return view.link_q(link.id) < AJAR_SHARE * link.range[1]


@phase("pull the door open")
def _pull_open(view: WorldView, link: JointedLink, path: LinkPath, goal: float) -> Motion:
    """Move the hand, which holds the bar, and the base along a path until the door is open by ``goal`` [rad].

    Returns False when the hand loses the door, or the motion is stuck.
    """
    aim = float(path.values[1])
    end = float(path.values[-1])
    hitch = _Hitch()
    for _ in range(ARC_STEPS):
        now = view.link_q(link.id)
        if now >= goal:
            return True
        step = _arc_step(path, aim, MAX_SWING_RAD, PULL_STEP_RAD)
        if aim - now < PULL_LEAD_RAD:
            aim = min(aim + step, end)
        if hitch.stops(view, aim == end) or (
            now < LOST_SHARE * goal and _has_lost(view, link)
        ):
            return False
        yield link_path.action(view, path, aim, step, motion.CLOSED)
    return False


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
    hitch = _Hitch()
    last = np.inf
    shut = 0
    for _ in range(ARC_STEPS):
        now = view.link_q(link.id)
        speed = style_of(view).speed * (last - now) / STEP_SECONDS
        if throws and _coasts(speed) > now + COAST_SPARE_RAD:
            return True
        # A door that is shut but moves may bounce open again.
        shut = shut + 1 if now <= goal and abs(now - last) < AT_REST_RAD else 0
        last = now
        if shut > PRESS_STEPS:
            return True
        step = _arc_step(path, aim, -MAX_SWING_RAD, JOINT_STEP_RAD)
        if not throws:
            step = min(step, PUSH_STEP_RAD[0] + PUSH_STEP_RAD[1] * max(now, 0.0))
        if now - aim < PRESS_AHEAD_RAD + PUSH_LEAD_RAD:
            aim = max(aim - step, end)
        if hitch.stops(view, aim == end):
            return False
        yield link_path.action(view, path, aim, -step, motion.CLOSED)
    return False


@dataclass
class _Hitch:
    """Tells when a motion along the arc of a door is stuck: it jams, or the door stays behind the end of the path."""

    jammed: int = 0
    late: int = 0

    def stops(self, view: WorldView, at_end: bool) -> bool:
        """Whether to give up in this control step; ``at_end``: the hand aims at the end of the path."""
        self.jammed = self.jammed + 1 if view.link_forces.sum() > JAMMED_FORCE_N else 0
        self.late = self.late + 1 if at_end else 0
        return self.jammed > JAMMED_STEPS or self.late > MAX_LAG_STEPS


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


def _coasts(speed: float) -> float:
    """Angle [rad] by which a released door swings on at a closing speed [rad/s], see `COAST_TIME_S`."""
    if not 0.0 < speed < np.inf:
        return 0.0
    return COAST_TIME_S * (
        speed - COAST_STOP_RAD_S * float(np.log1p(speed / COAST_STOP_RAD_S))
    )


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


def _has_lost(view: WorldView, link: JointedLink) -> bool:
    """Whether the fingers do not touch the handle and the tcp is beside it, measured horizontally."""
    if view.finger_forces(link.id).any():
        return False
    handle = link.handle_pose(view.link_q(link.id))[0]
    return bool(np.linalg.norm(motion.tcp(view)[0][:2] - handle[:2]) > LOST_M)


def _arc_step(path: LinkPath, angle: float, swing: float, joint_step: float) -> float:
    """Change of the door angle [rad] per control step that the arm's joints can follow at ``angle``.

    Args:
        path: configurations along the door's arc.
        angle: door angle [rad].
        swing: largest change, negative while the door closes [rad].
        joint_step: motion of an arm joint per control step [rad].
    """
    ahead = float(np.copysign(0.1, swing))
    motions = np.abs(path.at(angle + ahead) - path.at(angle))
    fastest = float(motions[list(path.robot.arm_columns)].max())
    return min(abs(swing), 0.1 * joint_step / max(fastest, 1e-6))


def _reachable(
    view: WorldView,
    link: JointedLink,
    found: LinkMotions,
    angles: np.ndarray,
    back: float = 0.0,
) -> LinkPath | None:
    """Select the motion that is reached first among those whose whole motion is collision-free in this home.

    Args:
        view: the world.
        link: the door.
        found: motions in the plan frame.
        angles: (K,) door angles of their way points [rad].
        back: length of the hand's straight line to the first way point; 0 for none.

    Returns:
        The motion in the world, with the route to it; None if there is none.
    """
    goals, _ = link_motions.rank(view, Frame.of(link), found)
    walls = Boxes.join([view.home.boxes, view.link_boxes((link.id,))])
    # Neighbours collide alike: variety finds a free motion with fewer checks.
    goals = goals[_distinct(goals[:, 0, :3])[:MOTIONS_TRIED]]
    free = np.array(
        [g for g in goals if motion.spheres(view.robot).clearance(g, walls).min() > 0.01]
    )
    if not len(free):
        return None
    before = _withdrawn(view.robot, free[:, 0], back) if back > 0 else None
    best = approach.best_route(view, free[:, 0], before, link if back > 0 else None)
    return None if best is None else LinkPath(view.robot, free[best[0]], angles, best[1])


def _distinct(base: np.ndarray) -> np.ndarray:
    """Indices of the first base pose (N, 3) in every grid cell of 0.1 m, 0.1 m, 0.2 rad, in ascending order."""
    _, first = np.unique(np.round(base / [0.1, 0.1, 0.2]), axis=0, return_index=True)
    return np.sort(first)


def _withdrawn(body: Robot, q: np.ndarray, back: float) -> np.ndarray:
    """Configurations ``q`` (M, J) with the hand moved back by ``back`` along its axis; unchanged where that fails."""
    robot = body.chain
    pos, rot = robot.tip_pose(q)
    found = ik.solve(
        robot,
        ik.TipGoals(pos - back * rot[:, :, 0], rot, ik.columns(robot), q[0]),
        q[:, None],
        options=ik.Options(iterations=25, rest_gain=0.0),
    )
    # A solution far off is another branch, to which no straight line leads.
    near = np.abs(found.q[:, 0, BASE.stop :] - q[:, BASE.stop :]).max(axis=1) < 1.2
    good = (
        found.ok[:, 0]
        & near
        & (
            motion.spheres(body).self_clearance(found.q[:, 0])
            > link_motions.SELF_CLEARANCE_M
        )
    )
    return np.where(good[:, None], found.q[:, 0], q)


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
