"""Opening and closing a hinged door: the hand follows the door's arc while the base drives along."""

from __future__ import annotations

import functools

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.joints import BASE
from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.planning import approach, link_path, stances
from mjhab.experts.planning.link_path import LinkPath
from mjhab.experts.planning.stances import Frame, Stances
from mjhab.experts.skills import door_stances
from mjhab.experts.skills.door_stances import HALF_OPEN_SHARE, OPEN_TO_SHARE, PRESS_AHEAD_RAD
from mjhab.experts.style import style_of, wait_for
from mjhab.robots.robot import Robot
from mjhab.tasks.style import PUSH

Array = np.ndarray
Motion = motion.Motion
AROUND_BAR_M = 0.045
"""Free space beside the bar in a hand that closes around it; wide open, the inner finger would push the door."""
LET_GO_BAR_M = 0.03
"""Free space beside the bar in a hand that lets go of it."""
OPEN_ENOUGH_SHARE = 0.753
"""Share of the range from which on an open door is left alone; success asks for 0.75."""
OPEN_SPARE_SHARE = 0.008
"""How much farther than `OPEN_TO_SHARE` a door is pulled, as a share of the range: what brushes against it later
must not close it below what success asks for."""
STILL_STEPS = 3
"""Control steps for which the hand holds the bar at the end: it would hit it on its way if the door went on."""
SHUT_SHARE = 0.006
"""Share of the range to which a door is pressed shut; success asks for 0.01."""
AJAR_SHARE = 0.009
"""Share of the range from which on it is pressed again."""
IN_LINE_M = 0.025
"""Greatest distance of the hand beside its way in behind the door."""
ENTERED_M = 0.04
"""Distance from the end of that way at which the hand is in."""
STRUCK_RAD = 0.15
"""How far the arm may push a door open on its way before the hand moves elsewhere."""
ENTER_STEP_M = 0.04
"""Motion of the hand per control step on its way in behind the door."""
ENTER_STEPS = 22
"""Way of the hand per control step [m], and control steps, to get in behind the door."""
BEHIND_WAY_M = 0.25
"""Length of the straight way of the hand in behind an open door."""
STANCES_TRIED = 16
"""Number of stances whose surroundings are checked."""
JOINT_STEP_RAD = 0.037
"""Motion of a joint per control step while the hand leads the door by its bar."""
PULL_STEP_RAD = 0.046
"""The same while it pulls: a door that is pushed must not leave the hand."""
MAX_SWING_RAD = 0.045
"""Largest motion of the hand's aim along the door's arc per control step."""
PUSH_STEP_RAD = 0.02, 0.045
"""Motion per control step of a door that is pushed all the way: a constant, and an addition per radian that it is
open. A slower door does not leave the hand."""
MAX_LAG_STEPS = 12
"""Control steps that the door may lag behind the end of the path before the hand gives up."""
COAST_TIME_S = 1.4
"""A door that is let go slows down by (speed + COAST_STOP_RAD_S) / COAST_TIME_S. Both follow from inertia, damping and
friction of the doors here, and tell how far a thrown door goes."""
COAST_STOP_RAD_S = 0.5
"""See `COAST_TIME_S`."""
COAST_SPARE_RAD = 0.1
"""A door is let go when it will coast this much farther than it has to; one that is much faster bounces open again."""
AT_REST_RAD = 0.002
"""Largest motion per control step of a door at rest."""
PRESS_STEPS = 2
"""Control steps for which a closed door has to rest."""
JAMMED_FORCE_N = 300.0
"""Contact force on the arm at which a motion is given up."""


def open_door(view: WorldView, link: JointedLink) -> Motion:
    """Grasp the bar, follow its arc, let go and return to rest; anew after a slip."""
    enough = OPEN_ENOUGH_SHARE * link.range[1]
    # Stances are searched for once per value: a range of values must not mean one search per episode.
    further = round(style_of(view).open_further, 2)
    end = (OPEN_TO_SHARE + OPEN_SPARE_SHARE + further) * link.range[1]
    job = f"pull {further}" if further else "pull"
    search = functools.partial(door_stances.pull_stances, further=further)
    while view.steps_left > 40 and view.link_q(link.id) < enough:
        found = stances.cached(view.robot, link, job, search)
        path = _reachable(view, link, found, door_stances.pull_angles(link, further))
        if path is None:
            return False
        around, loose = (
            motion.gripper_at(view.robot, link.handle.thickness + room)
            for room in (AROUND_BAR_M, LET_GO_BAR_M)
        )
        yield from approach.go(view, path.route, around)
        rot = path.hand_at(path.values[1])[1]
        if (
            yield from approach.take(view, link, rot, path.q[1], height=path.height, gripper=around)
        ):
            yield from _follow_arc(view, link, path, end, motion.CLOSED)
        until = wait_for(view, motion.is_quiet)
        yield from motion.hold(view, STILL_STEPS, gripper=motion.CLOSED, until=until)
        yield from approach.let_go(view, 0.12, gripper=loose)
    return (yield from approach.fold(view, gripper=motion.CLOSED))


def close_door(view: WorldView, link: JointedLink) -> Motion:
    """Reach behind the door and throw it shut along its arc, folding the arm while it swings, or push it all the way
    where that is asked for; anew if it stays ajar."""
    throws = style_of(view).close != PUSH
    while view.steps_left > 40 and view.link_q(link.id) > AJAR_SHARE * link.range[1]:
        start = view.link_q(link.id) + PRESS_AHEAD_RAD
        half = start < HALF_OPEN_SHARE * link.range[1]
        search = door_stances.push_half_open if half else door_stances.push_open
        angles = door_stances.push_angles(link, half)
        found, angles = _from_angle(
            view.robot,
            stances.cached(view.robot, link, search.__name__, search),
            angles,
            min(start, angles[0]),
        )
        path = _reachable(view, link, found, angles, BEHIND_WAY_M)
        if path is None:
            return False
        yield from approach.go(view, path.route, motion.CLOSED)
        if view.link_q(link.id) > start - PRESS_AHEAD_RAD + STRUCK_RAD:
            continue
        yield from _behind_edge(view, path)
        while (
            yield from _follow_arc(
                view, link, path, SHUT_SHARE * link.range[1], motion.CLOSED, throws
            )
        ):
            if (yield from _leave_swinging(view, link)):
                break
        else:
            yield from approach.retreat(view, 0.06)
    return (yield from approach.fold(view))


def _follow_arc(
    view: WorldView,
    link: JointedLink,
    path: LinkPath,
    goal: float,
    gripper: float,
    throws: bool = False,
) -> Motion:
    """Move hand and base along the path until the door is at ``goal``, or gets there by itself where the hand
    ``throws`` it; False when the hand loses the door."""
    way = 1.0 if goal > view.link_q(link.id) else -1.0
    aim = float(path.values[1 if way > 0 else 0])
    end = float(path.values[-1])
    aim = aim if way > 0 else min(aim, view.link_q(link.id) + PRESS_AHEAD_RAD)
    last = np.inf
    late = 0
    pressed = 0
    done = 0
    for _ in range(110):
        now = view.link_q(link.id)
        if (
            throws
            and _coasts(style_of(view).speed * (last - now) / STEP_SECONDS) > now + COAST_SPARE_RAD
        ):
            return True
        # A door that was thrown shut may swing back.
        there = way * (goal - now) <= 0 and (way > 0 or abs(now - last) < AT_REST_RAD)
        done = done + 1 if there else 0
        last = now
        if done > (0 if way > 0 else PRESS_STEPS):
            return True
        pressed = pressed + 1 if view.link_forces.sum() > JAMMED_FORCE_N else 0
        pace = _pace(path, aim, way)
        if way < 0 and not throws:
            pace = min(pace, PUSH_STEP_RAD[0] + PUSH_STEP_RAD[1] * max(now, 0.0))
        if way * (aim - now) < (0.3 if way > 0 else PRESS_AHEAD_RAD + 0.15):
            aim += way * pace
        aim = min(aim, end) if way > 0 else max(aim, end)
        late = late + 1 if aim == end else 0
        if pressed > 2 or late > MAX_LAG_STEPS:
            return False
        if (
            way > 0
            and not view.finger_forces(link.id).any()
            and now < 0.9 * goal
            and _far(view, link, path)
        ):
            return False
        yield link_path.action(view, path, aim, way * pace, gripper)
    return False


def _leave_swinging(view: WorldView, link: JointedLink) -> Motion:
    """Fold the arm while a door swings shut; False when it comes to rest too early."""
    last = np.inf
    for action in approach.fold(view, shut=link, gripper=motion.CLOSED):
        now = view.link_q(link.id)
        if now > AJAR_SHARE * link.range[1] and abs(now - last) < AT_REST_RAD:
            return False
        last = now
        yield action
    return True


def _coasts(speed: float) -> float:
    """How far a door goes on by itself [rad] at a closing speed [rad/s]."""
    if not 0.0 < speed < np.inf:
        return 0.0
    return COAST_TIME_S * (speed - COAST_STOP_RAD_S * float(np.log1p(speed / COAST_STOP_RAD_S)))


def _behind_edge(view: WorldView, path: LinkPath) -> Motion:
    """Bring the hand to the beginning of a path straight along its axis, and forward only as far as it is in line: with
    the base not quite in place it would meet the door's edge."""
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
        aim_rot = ik.straight_line(here[None], pos[None], turn[None], rot[None], 1.0, 0.1)[1]
        v, w = approach.base_towards(view, wish)
        delta = ik.servo(
            robot,
            view.q,
            goal[None],
            aim_rot,
            ik.columns(robot),
            rest=wish,
            base_next=approach.next_base(view, v, w),
            options=ik.ServoOptions(mode="approach", rest_gain=0.1),
        )[0]
        yield motion.action(
            view, view.q + delta / motion.ARM_STEP_SHARE, gripper=motion.CLOSED, drive=(v, w)
        )
    return False


def _far(view: WorldView, link: JointedLink, path: LinkPath) -> bool:
    handle = link.handle_pose(view.link_q(link.id))[0]
    return bool(np.linalg.norm(motion.tcp(view)[0][:2] - handle[:2]) > 0.06)


def _pace(path: LinkPath, angle: float, way: float) -> float:
    """Door motion per control step that the arm's joints can follow [rad]."""
    here = path.at(angle)
    there = path.at(angle + way * 0.1)
    most = float(np.abs(there - here)[list(path.robot.arm_columns)].max())
    return min(
        MAX_SWING_RAD, 0.1 * (PULL_STEP_RAD if way > 0 else JOINT_STEP_RAD) / max(most, 1e-6)
    )


def _reachable(
    view: WorldView, link: JointedLink, found: Stances, angles: Array, back: float = 0.0
) -> LinkPath | None:
    """The soonest reached stance whose whole motion has room in this home; ``back`` [m]: how far from its beginning the
    hand comes straight in."""
    goals, _ = stances.rank(view, Frame.of(link), found)
    walls = Boxes.join([view.home.boxes, view.link_boxes((link.id,))])
    goals = goals[_distinct(goals[:, 0, :3])[:STANCES_TRIED]]
    free = np.array(
        [g for g in goals if motion.spheres(view.robot).clearance(g, walls).min() > 0.01]
    )
    if not len(free):
        return None
    before = _withdrawn(view.robot, free[:, 0], back) if back > 0 else None
    best = approach.best_route(view, free[:, 0], before, link if back > 0 else None)
    return None if best is None else LinkPath(view.robot, free[best[0]], angles, best[1])


def _distinct(base: Array) -> Array:
    """Indices of the first of every group of like base poses (N, 3), in order."""
    _, first = np.unique(np.round(base / [0.1, 0.1, 0.2]), axis=0, return_index=True)
    return np.sort(first)


def _withdrawn(body: Robot, q: Array, back: float) -> Array:
    """Configurations (M, Q) with the hand drawn back along its own axis, where the arm can do that."""
    robot = body.chain
    pos, rot = robot.tip_pose(q)
    found = ik.solve(
        robot,
        pos - back * rot[:, :, 0],
        rot,
        q[:, None],
        ik.columns(robot),
        rest=q[0],
        options=ik.Options(iterations=25, rest_gain=0.0),
    )
    near = np.abs(found.q[:, 0, BASE.stop :] - q[:, BASE.stop :]).max(axis=1) < 1.2
    good = (
        found.ok[:, 0]
        & near
        & (motion.spheres(body).self_clearance(found.q[:, 0]) > stances.SELF_CLEARANCE_M)
    )
    return np.where(good[:, None], found.q[:, 0], q)


def _from_angle(body: Robot, found: Stances, angles: Array, start: float) -> tuple[Stances, Array]:
    """What is left of the motions when they begin at the door angle ``start``, and the angles of what is left."""
    k = int(np.searchsorted(-angles, -start))
    if k == 0:
        return found, angles
    share = (angles[k - 1] - start) / (angles[k - 1] - angles[k])
    first = (1.0 - share) * found.q[:, k - 1] + share * found.q[:, k]
    robot = body.chain
    steps = ik.travel_steps(robot, body.rest, first, ik.columns(robot))
    q = np.concatenate([first[:, None], found.q[:, k:]], axis=1)
    return Stances(q, steps, found.back), np.append(start, angles[k:])
