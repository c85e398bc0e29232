"""Motions that drawers and doors have in common: driving to a base placement, grasping a handle, releasing it.

Lengths [m], angles [rad], world frame. Letters: M configurations, J joints, T samples of a route.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import numpy as np

from mjhab.core.boxes import Boxes, sphere_box_distance
from mjhab.core.joints import BASE, BASE_XY, BASE_YAW
from mjhab.core.rotations import wrap
from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.arm.clearance import RobotSpheres
from mjhab.experts.base.ajar import planner
from mjhab.experts.base.route import Route, RouteWish, follow, plan_route
from mjhab.experts.phases import phase
from mjhab.experts.style import follows_rule, wait_for
from mjhab.robots.robot import Robot

Motion = motion.Motion
FUNNEL_STEP_M = 0.02
"""Motion of the hand per control step while the open fingers move over a handle."""
STRADDLE_M = 0.068
"""Distance from the tool centre to a handle at which the fingertips do not reach it yet."""
ALONG_BAR_M = 0.04
"""Largest distance along the bar between the planned and the actual grasp."""
RETRACT_CLEARANCE_M = 0.005
"""Least clearance of a route on which the arm moves to its rest pose."""
ROUTES_TRIED = 5
"""Number of base placements for which a route is planned."""
MAX_ROUTES_TRIED = 12
"""The same while no route without a collision has been found."""
TOUCH_SPARE_M = 0.221
"""Distance beyond the reach of the tcp from which on the arm cannot touch anything: fingers, hand and clearance."""
MAX_ROUTE_DEFICIT_M = 0.012
"""Maximum clearance deficit along a route: `plan_route` allows for errors of the drive."""
AMBIGUOUS_TURN_RAD = 2.8
"""Largest turn at the end of a route. With a larger one the base may turn the other way, through unchecked poses. The
follower takes the shorter turn, which changes at pi."""
SECOND_CHOICE_STEPS = 8.0
"""Cost of using the second configuration of a base placement instead of the first [control steps]."""
BLOCKED_PRICE_STEPS = 1000.0
"""Cost of a route with a collision [control steps]."""


def obstacles(
    view: WorldView, goals: np.ndarray, shut: JointedLink | None = None
) -> Boxes:
    """Boxes within the arm's reach of the present base pose or of ``goals`` (M, 3+): walls, furniture, and links at
    their present joint positions. The link ``shut`` counts as closed."""
    links = (
        [view.link_boxes()]
        if shut is None
        else [view.link_boxes((shut.id,)), shut.boxes(0.0)]
    )
    boxes = Boxes.join([view.home.boxes, *links])
    places = np.concatenate([view.base[None, :2], goals[:, :2]])
    # From the floor to above the shoulder: an arm reaches boxes at any of them.
    heights = np.array([0.3, 1.0, 1.6])
    points = np.array([[*place, z] for place in places for z in heights])
    reach = view.robot.reach
    touches = reach.ahead + reach.out + reach.length + reach.hand + TOUCH_SPARE_M
    return boxes.take(
        np.flatnonzero(sphere_box_distance(points, boxes).min(axis=0) < touches)
    )


def best_route(
    view: WorldView,
    goals: np.ndarray,
    others: np.ndarray | None = None,
    link: JointedLink | None = None,
) -> tuple[int, Route] | None:
    """The quickest collision-free route to one of several configurations.

    Args:
        view: world to plan in.
        goals: (M, J) configurations, preferred ones first. By the rule the first one with a collision-free route is
            taken.
        others: (M, J) second choice for every goal, at a cost of `SECOND_CHOICE_STEPS`; used when driving backwards.
        link: a door that the hand must not pass through. It is checked at two samples per control step, because a fast
            hand could pass through it between two control steps.

    Returns:
        Index of the configuration and the route to it, forwards or backwards. If every route has a collision, the one
        with the most clearance; None when there is no route.
    """
    boxes = obstacles(view, goals[:MAX_ROUTES_TRIED])
    door = None if link is None else link.boxes(view.link_q(link.id))
    best: tuple[float, int, Route] | None = None
    tried = 1 if follows_rule(view) else ROUTES_TRIED
    for i, goal in enumerate(goals[:MAX_ROUTES_TRIED]):
        if i >= tried and best is not None and best[0] < BLOCKED_PRICE_STEPS:
            break
        # A drive backwards ends with less turning, but from the other side: the second choice suits it better.
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
    """Duration of a route [control steps], plus `BLOCKED_PRICE_STEPS` and more if it has a collision."""
    lack = max(-route.clearance, 0.0)
    if door is not None and lack < MAX_ROUTE_DEFICIT_M:
        gap = _hand(view.robot).clearance(_passed(view, route), door).min()
        lack += max(MAX_ROUTE_DEFICIT_M - float(gap), 0.0)
    if _turn_at_end(route) > AMBIGUOUS_TURN_RAD:
        lack += MAX_ROUTE_DEFICIT_M
    return (
        route.steps
        + 400.0 * lack
        # Also among blocked ones the least blocked comes first.
        + (0.0 if lack < MAX_ROUTE_DEFICIT_M else BLOCKED_PRICE_STEPS + 1e4 * lack)
    )


def _hand(robot: Robot) -> RobotSpheres:
    """Spheres of wrist and fingers."""
    return motion.spheres(robot).only([*robot.wrist_links, *robot.finger_links])


def _turn_at_end(route: Route) -> float:
    """Angle by which the base turns in place at the end of a route [rad]."""
    distance = route.segment.points[-1] - route.segment.points[-2]
    if np.linalg.norm(distance) < 0.03:
        return 0.0
    heading = np.arctan2(distance[1], distance[0]) + (
        0.0 if route.segment.direction > 0 else np.pi
    )
    return float(np.abs(wrap(route.segment.yaw - heading)))


def _passed(view: WorldView, route: Route) -> np.ndarray:
    """Expected configurations (T, J) on a route, two per control step."""
    poses = route.base.poses
    robot = view.robot.chain
    needed = float(ik.travel_steps(robot, view.q, route.arm, ik.columns(robot)))
    steps = np.arange(0.0, route.steps + 0.25, 0.5)
    part = np.clip((steps - route.delay) / max(needed, 1.0), 0.0, 1.0)[:, None]
    out = view.q + part * (route.arm - view.q)
    out[:, :3] = np.stack(
        [np.interp(steps, np.arange(len(poses)), column) for column in poses.T],
        axis=1,
    )
    return out


def creep(
    view: WorldView, posture: np.ndarray, heading: float, speed: float, gripper: float
) -> np.ndarray:
    """Action (A,) that drives at ``speed`` [m/s] along ``heading`` [rad] with the arm at ``posture`` (J,)."""
    turn = float(np.clip(3.0 * wrap(heading - view.base[2]), -0.5, 0.5))
    return motion.action(view, posture, gripper=gripper, drive=(speed, turn))


@phase("let go of the handle", "release")
def let_go(
    view: WorldView, distance: float, *, gripper: float = motion.OPEN, speed: float = 0.3
) -> Motion:
    """Open the hand, then move it backwards along its own axis by ``distance`` [m] with base and arm.

    Args:
        view: world to act in.
        distance: distance of the motion [m].
        gripper: gripper action, -1..1.
        speed: of the hand [m/s].
    """
    until = wait_for(view, motion.has_opened(gripper))
    yield from motion.hold(view, 4, gripper=gripper, until=until)
    pos, rot = motion.tcp(view)
    goal = pos - distance * rot[:, 0]
    along = float(-rot[:2, 0] @ motion.ahead(view.base[2]))
    return (
        yield from motion.move_tcp(
            view,
            motion.HandMove(
                pos=goal,
                rot=rot,
                gripper=gripper,
                speed=speed,
                # Backwards only: forwards the base would follow the hand into the furniture.
                drive=(speed * min(along, 0.0), 0.0),
                tolerance=0.02,
                angle_tolerance=0.5,
                max_steps=14,
            ),
        )
    )


@phase("retract the arm", "retract")
def retract(
    view: WorldView,
    distances: tuple[float, ...] = (0.0, 0.15, 0.3, 0.45, 0.6),
    shut: JointedLink | None = None,
    gripper: float = motion.OPEN,
) -> Motion:
    """Bring the arm to its rest pose; the base first drives backwards as far as a collision-free motion requires.

    Args:
        view: world to act in.
        distances: distances that the base may drive backwards [m], tried in this order.
        shut: a door that counts as closed.
        gripper: gripper action. Close the fingers near the edge of a door, which open fingers could catch.
    """
    q = view.q
    rest = motion.rest_goal(view)
    boxes = obstacles(view, q[None], shut)
    floor = planner(view, shut=True)
    best: Route | None = None
    for distance in distances:
        goal = q[BASE] - distance * motion.ahead_3d(q[BASE_YAW])
        # What blocks a short drive backwards blocks a longer one.
        if distance > 0 and floor.line_clearance(q[BASE_XY], goal[None, :2])[0] < min(
            view.robot.footprint.wide, float(floor.clearance_at(q[BASE_XY]))
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
        if found is not None and (
            # A longer drive must be worth more than noise.
            best is None or found.clearance > best.clearance + 0.002
        ):
            best = found
        if found is not None and found.clearance > RETRACT_CLEARANCE_M:
            break
    if best is not None:
        yield from follow(view, best, gripper=gripper, tolerance=0.03)
    return (yield from motion.to_rest(view, gripper=gripper))


@phase("drive back", "retract")
def retreat(view: WorldView, distance: float, speed: float = 0.4) -> Motion:
    """Drive ``distance`` [m] backwards at ``speed`` [m/s] with the arm held. Returns whether the base arrived."""
    posture = view.q
    start = view.base[:2]
    heading = float(view.base[2])
    for _ in range(20):
        if np.linalg.norm(view.base[:2] - start) >= distance:
            return True
        yield creep(view, posture, heading, -speed, motion.CLOSED)
    return False


@phase("grasp the handle", "approach")
def take(
    view: WorldView,
    link: JointedLink,
    rot: np.ndarray,
    posture: np.ndarray,
    *,
    height: float | None = None,
    gripper: float = motion.OPEN,
) -> Motion:
    """Move the open fingers over a handle and close them, up to two times.

    Args:
        view: world to act in.
        link: drawer or door with the handle.
        rot: (3, 3) rotation of the hand in the world.
        posture: (J,) preferred configuration.
        height: of the grasp on a vertical bar above the floor [m]; None for the middle of the bar.
        gripper: gripper action while the hand moves, -1..1.

    Returns:
        Whether both fingers press on the handle.
    """
    for _ in range(2):
        # A first try may have moved the link.
        handle, _, _ = link.handle_pose(view.link_q(link.id))
        if height is not None:
            handle = np.array([*handle[:2], height])
        there = yield from _funnel(view, handle, rot, posture, gripper)
        if there and (yield from motion.close_fingers(view, link.id)):
            return True
    return False


def _funnel(
    view: WorldView,
    goal: np.ndarray,
    rot: np.ndarray,
    posture: np.ndarray,
    gripper: float,
    max_steps: int = 40,
) -> Motion:
    """Bring the hand to ``goal`` (3,) so that the open fingers pass on both sides of the bar without touching it.

    The hand moves forward only while it is laterally aligned with the bar. Errors along the bar (the z axis of the
    hand) are tolerated up to `ALONG_BAR_M`. Returns whether the hand arrived.
    """
    dofs = ik.columns(view.robot.chain)
    for step in range(max_steps):
        here, turn = motion.tcp(view)
        ahead, across, along = rot.T @ (goal - here)
        # Late in the try a grasp that is a little off is better than none.
        loose = 1.0 if step < max_steps // 2 else 1.5
        if (
            abs(ahead) < 0.014 * loose
            and abs(across) < 0.008 * loose
            and abs(along) < ALONG_BAR_M
        ):
            return True
        # Within a finger's reach of the handle the hand advances only in line with it.
        gap = max(ahead - FUNNEL_STEP_M, 0.0 if abs(across) < 0.015 else STRADDLE_M)
        clear = abs(across) < 0.015 or ahead > STRADDLE_M - 0.012
        shift = np.array([ahead - gap, across if clear else 0.0, along])
        shift *= min(1.0, 0.03 / max(float(np.linalg.norm(shift)), 1e-9))
        aim_rot = ik.straight_line(
            here[None], goal[None], turn[None], rot[None], 1.0, 0.06
        )[1]
        aim = ik.TipGoals((here + rot @ shift)[None], aim_rot, dofs, posture)
        drive = base_towards(view, posture)
        yield motion.hand_action(view, aim, gripper=gripper, drive=drive)
    return False


def base_towards(
    view: WorldView, wish: np.ndarray, speed: float = 0.0, max_speed: float = 0.5
) -> tuple[float, float]:
    """Forward speed [m/s] and yaw rate [rad/s] that bring the base towards a nearby pose ``wish`` (3+,).

    A lateral error stays: the base only drives along its heading and turns to that of the pose.

    Args:
        view: world to act in.
        wish: (3+,) x, y, yaw of the wished pose.
        speed: at which the pose itself moves along the heading [m/s].
        max_speed: largest forward speed [m/s].
    """
    q = view.q
    ahead = float((wish[:2] - q[BASE_XY]) @ motion.ahead(q[BASE_YAW]))
    v = float(np.clip(speed + 1.5 * ahead, -max_speed, max_speed))
    return v, float(np.clip(3.0 * wrap(wish[2] - q[BASE_YAW]), -0.6, 0.6))
