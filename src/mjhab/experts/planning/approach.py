"""Motions that drawers and doors have in common: getting to a stance, taking a handle, letting go."""

from __future__ import annotations

import numpy as np

from mjhab.core.boxes import Boxes, sphere_box_distance
from mjhab.core.joints import BASE, BASE_XY, BASE_YAW
from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.arm.clearance import RobotSpheres
from mjhab.experts.base.pilot import simulate
from mjhab.experts.base.route import Route, RouteWish, follow, plan_route
from mjhab.experts.style import wait_for
from mjhab.robots.kinematics import wrap
from mjhab.robots.robot import Robot

Array = np.ndarray
Motion = motion.Motion
FUNNEL_STEP_M = 0.02
"""Motion of the hand per control step while it comes onto a handle."""
STRADDLE_M = 0.068
"""Distance from the tool centre to a handle at which the fingertips do not reach it yet."""
ALONG_BAR_M = 0.04
"""Greatest distance along the bar from the wished place at which a handle may be taken."""
FOLD_CLEARANCE_M = 0.005
"""Clearance with which the arm folds."""
RETREAT_CLEARANCE_M = 0.29
"""Clearance of the base on the floor when it backs away."""
ROUTES_TRIED = 5
"""Number of stances whose route is planned."""
MAX_ROUTES_TRIED = 12
"""The same while none of them has a clear route."""
ARM_REACH_M = 1.3
"""Distance from the base beyond which the arm touches nothing."""
MAX_ROUTE_DEFICIT_M = 0.012
"""Maximum clearance deficit along a route: `plan_route` allows for errors of the drive."""
AMBIGUOUS_TURN_RAD = 2.8
"""Turns at the end that are larger than this might be driven the other way round, along poses that were not checked."""
SECOND_CHOICE_STEPS = 8.0
"""Control steps between the second and the first configuration of a stance."""
BLOCKED_PRICE_STEPS = 1000.0
"""Cost of a route that touches something."""


def obstacles(view: WorldView, goals: Array, shut: JointedLink | None = None) -> Boxes:
    """What the robot might touch on its way to some base poses (M, 3+): walls, furniture, links as they are now but
    for ``shut``, which counts as closed."""
    links = [view.link_boxes()] if shut is None else [view.link_boxes((shut.id,)), shut.boxes(0.0)]
    boxes = Boxes.join([view.home.boxes, *links])
    places = np.concatenate([view.base[None, :2], goals[:, :2]])
    heights = np.array([0.3, 1.0, 1.6])
    points = np.array([[*place, z] for place in places for z in heights])
    return boxes.take(np.flatnonzero(sphere_box_distance(points, boxes).min(axis=0) < ARM_REACH_M))


def best_route(
    view: WorldView, goals: Array, others: Array | None = None, link: JointedLink | None = None
) -> tuple[int, Route] | None:
    """The quickest way to one of some configurations (M, J), most wanted first, that touches nothing.

    Args:
        others: (M, J) configurations that will do as well but for some more steps.
        link: a door that the hand must not pass through: a fast hand could seem to jump from one side to the other.

    Returns:
        The index of the configuration and the way there, forwards or backwards; where none is free, the one with the
        most room; None when there is no way at all.
    """
    boxes = obstacles(view, goals[:MAX_ROUTES_TRIED])
    door = None if link is None else link.boxes(view.link_q(link.id))
    best: tuple[float, int, Route] | None = None
    for i, goal in enumerate(goals[:MAX_ROUTES_TRIED]):
        if i >= ROUTES_TRIED and best is not None and best[0] < BLOCKED_PRICE_STEPS:
            break
        # Backing up to a place turns the hand less, but from the other side: then it rather comes straight in.
        for direction, end, more in (
            (1, goal, 0.0),
            (-1, goal if others is None else others[i], SECOND_CHOICE_STEPS),
        ):
            found = plan_route(
                view,
                end[:3],
                end,
                motion.spheres(view.robot),
                boxes,
                RouteWish(direction=direction),
            )
            if found is None:
                continue
            cost = _cost(view, found, door) + (0.0 if others is None else more)
            if best is None or cost < best[0]:
                best = (cost, i, found)
    return None if best is None else (best[1], best[2])


def _cost(view: WorldView, route: Route, door: Boxes | None) -> float:
    """Steps a route takes, and a lot more where it is blocked."""
    lack = max(-route.room, 0.0)
    if door is not None and lack < MAX_ROUTE_DEFICIT_M:
        gap = _hand(view.robot).clearance(_passed(view, route), door).min()
        lack += max(MAX_ROUTE_DEFICIT_M - float(gap), 0.0)
    if _turn_at_end(route) > AMBIGUOUS_TURN_RAD:
        lack += MAX_ROUTE_DEFICIT_M
    return (
        route.steps
        + 400.0 * lack
        + (0.0 if lack < MAX_ROUTE_DEFICIT_M else BLOCKED_PRICE_STEPS + 1e4 * lack)
    )


def _hand(robot: Robot) -> RobotSpheres:
    """Spheres of wrist and fingers."""
    return motion.spheres(robot).only([*robot.wrist_links, *robot.finger_links])


def _turn_at_end(route: Route) -> float:
    """How far the base turns on the spot where a route ends [rad]."""
    way = route.path[-1] - route.path[-2]
    if np.linalg.norm(way) < 0.03:
        return 0.0
    heading = np.arctan2(way[1], way[0]) + (0.0 if route.direction > 0 else np.pi)
    return float(np.abs(wrap(route.yaw - heading)))


def _passed(view: WorldView, route: Route) -> Array:
    """Configurations (T, J) expected on a route, two for every control step."""
    poses = simulate(view.base, route.path, route.yaw, route.direction, route.lookahead, route.care)
    robot = view.robot.chain
    needed = float(ik.travel_steps(robot, view.q, route.arm, ik.columns(robot)))
    steps = np.arange(0.0, route.steps + 0.25, 0.5)
    part = np.clip((steps - route.delay) / max(needed, 1.0), 0.0, 1.0)[:, None]
    out = view.q + part * (route.arm - view.q)
    out[:, :3] = np.stack(
        [np.interp(steps, np.arange(len(poses)), column) for column in np.array(poses).T], axis=1
    )
    return out


def go(view: WorldView, route: Route, gripper: float) -> Motion:
    """Bring base and arm to the end of a route."""
    return (yield from follow(view, route, gripper=gripper))


def creep(view: WorldView, posture: Array, heading: float, speed: float, gripper: float) -> Array:
    """One action: drive at ``speed`` [m/s] along ``heading``, the arm held."""
    turn = float(np.clip(3.0 * wrap(heading - view.base[2]), -0.5, 0.5))
    return motion.action(view, posture, gripper=gripper, drive=(speed, turn))


def let_go(
    view: WorldView, way: float, *, gripper: float = motion.OPEN, speed: float = 0.3
) -> Motion:
    """Open the hand, then draw it straight back [m] from what it held, base and arm together."""
    until = wait_for(view, motion.has_opened(gripper))
    yield from motion.hold(view, 4, gripper=gripper, until=until)
    pos, rot = motion.tcp(view)
    goal = pos - way * rot[:, 0]
    along = float(-rot[:2, 0] @ np.array([np.cos(view.base[2]), np.sin(view.base[2])]))
    return (
        yield from motion.move_tcp(
            view,
            motion.HandMove(
                pos=goal,
                rot=rot,
                gripper=gripper,
                speed=speed,
                drive=(speed * min(along, 0.0), 0.0),
                tolerance=0.02,
                angle_tolerance=0.5,
                max_steps=14,
            ),
        )
    )


def fold(
    view: WorldView,
    ways: tuple[float, ...] = (0.0, 0.15, 0.3, 0.45, 0.6),
    shut: JointedLink | None = None,
    gripper: float = motion.OPEN,
) -> Motion:
    """Bring the arm to rest, backing away first as far [m] as it needs to touch nothing.

    Args:
        ways: how far it may back away [m], tried in this order.
        shut: a door that will be closed by then.
        gripper: open fingers might take hold of the edge of a door nearby.
    """
    q = view.q
    rest = motion.rest_goal(view)
    boxes = obstacles(view, q[None], shut)
    floor = motion.planner(view.home)
    best: Route | None = None
    for way in ways:
        goal = q[BASE] - way * np.array([np.cos(q[BASE_YAW]), np.sin(q[BASE_YAW]), 0.0])
        if way > 0 and floor.line_clearance(q[BASE_XY], goal[None, :2])[0] < min(
            RETREAT_CLEARANCE_M, float(floor.clearance_at(q[BASE_XY]))
        ):
            break
        found = plan_route(
            view,
            goal,
            rest,
            motion.spheres(view.robot),
            boxes,
            RouteWish(direction=-1, straight=True),
        )
        if found is not None and (best is None or found.room > best.room + 0.002):
            best = found
        if found is not None and found.room > FOLD_CLEARANCE_M:
            break
    if best is not None:
        yield from follow(view, best, gripper=gripper, tolerance=0.03)
    return (yield from motion.to_rest(view, gripper=gripper))


def retreat(view: WorldView, way: float, speed: float = 0.4) -> Motion:
    """Drive ``way`` [m] backwards with the arm held."""
    posture = view.q
    start = view.base[:2]
    heading = float(view.base[2])
    for _ in range(20):
        if np.linalg.norm(view.base[:2] - start) >= way:
            return True
        yield creep(view, posture, heading, -speed, motion.CLOSED)
    return False


def take(
    view: WorldView,
    link: JointedLink,
    rot: Array,
    posture: Array,
    *,
    height: float | None = None,
    gripper: float = motion.OPEN,
) -> Motion:
    """Put the open hand onto the handle and close it. Returns whether both fingers press.

    Args:
        rot: (3, 3) of the hand in the world.
        posture: preferred configuration (J,).
        height: where on an upright bar [m]; None: its middle.
        gripper: how wide the hand is open on its way.
    """
    for _ in range(2):
        handle, _, _ = link.handle_pose(view.link_q(link.id))
        if height is not None:
            handle = np.array([*handle[:2], height])
        there = yield from _funnel(view, handle, rot, posture, gripper)
        if there and (yield from motion.close_fingers(view, link.id)):
            return True
    return False


def _funnel(
    view: WorldView, goal: Array, rot: Array, posture: Array, gripper: float, max_steps: int = 40
) -> Motion:
    """Bring the hand to ``goal``, forward only as far as it is in line: open fingers must not hit what they straddle.

    Along the bar (the hand's z axis) the place matters little.
    """
    robot = view.robot.chain
    dofs = ik.columns(robot)
    for step in range(max_steps):
        here, turn = motion.tcp(view)
        ahead, across, along = rot.T @ (goal - here)
        loose = 1.0 if step < max_steps // 2 else 1.5
        if abs(ahead) < 0.014 * loose and abs(across) < 0.008 * loose and abs(along) < ALONG_BAR_M:
            return True
        # Within a finger's reach of the handle the hand advances only in line with it.
        gap = max(ahead - FUNNEL_STEP_M, 0.0 if abs(across) < 0.015 else STRADDLE_M)
        clear = abs(across) < 0.015 or ahead > STRADDLE_M - 0.012
        shift = np.array([ahead - gap, across if clear else 0.0, along])
        shift *= min(1.0, 0.03 / max(float(np.linalg.norm(shift)), 1e-9))
        aim_rot = ik.straight_line(here[None], goal[None], turn[None], rot[None], 1.0, 0.06)[1]
        v, w = base_towards(view, posture)
        ahead_base = next_base(view, v, w)
        aim = (here + rot @ shift)[None]
        delta = ik.servo(robot, view.q, aim, aim_rot, dofs, rest=posture, base_next=ahead_base)[0]
        yield motion.action(
            view, view.q + delta / motion.ARM_STEP_SHARE, gripper=gripper, drive=(v, w)
        )
    return False


def base_towards(
    view: WorldView, wish: Array, speed: float = 0.0, most: float = 0.5
) -> tuple[float, float]:
    """Forward speed [m/s] and yaw rate [rad/s] that bring the base to a near pose ``wish`` (3+,), as far as it can go
    without turning aside; ``speed``: that of the pose itself along the heading."""
    q = view.q
    ahead = float((wish[:2] - q[BASE_XY]) @ np.array([np.cos(q[BASE_YAW]), np.sin(q[BASE_YAW])]))
    v = float(np.clip(speed + 1.5 * ahead, -most, most))
    return v, float(np.clip(3.0 * wrap(wish[2] - q[BASE_YAW]), -0.6, 0.6))


def next_base(view: WorldView, v: float, w: float) -> Array:
    """Where the base will be (1, 3) after a control step."""
    q = view.q
    return (
        q[None, BASE]
        + np.array([[v * np.cos(q[BASE_YAW]), v * np.sin(q[BASE_YAW]), w]]) * STEP_SECONDS
    )
