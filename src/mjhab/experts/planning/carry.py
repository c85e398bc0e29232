"""Driving into furniture and out of it with the arm held, and ways back to the rest pose.

Lengths [m], angles [rad], world frame. Letters: J joints, H spheres.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.joints import BASE, BASE_XY, BASE_YAW
from mjhab.core.rotations import wrap
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.arm.clearance import RobotSpheres
from mjhab.experts.arm.held import held_spheres, holds
from mjhab.experts.arm.motion import Motion
from mjhab.experts.base.ajar import planner
from mjhab.experts.base.limits import UNLIMITED, limits_for
from mjhab.experts.base.route import (
    BLOCKED_FORCE_N,
    BLOCKED_STEPS,
    Route,
    RouteWish,
    follow,
    plan_route,
)
from mjhab.experts.phases import phase
from mjhab.experts.planning.sampled import MAX_DEFICIT_M, plan_around
from mjhab.experts.planning.workplace import surroundings
from mjhab.experts.style import follows_rule
from mjhab.robots.robot import Robot

BACK_DISTANCES_M = (0.0, 0.2, 0.4, 0.6, 0.8)
"""Distances that the base may drive backwards while the arm moves to its rest pose."""
OUT_DISTANCES_M = (0.42, 0.55, 0.7)
"""The same from the inside of a shelf. From `SHELF_DEPTH_M` on."""
OUT_STEPS = 25
"""Control steps of a drive out of a shelf at `FAST_SPEED_M_S`, and to come to rest at the end. `SHELF_DEPTH_M` takes 12
of them."""
HOME_DELAY = 1.2
"""Control steps that the arm needs to its rest pose, as a multiple of `motion.steps_home`."""
AROUND_BACK_DISTANCES_M = (0.0, 0.3)
"""The same for routes of `plan_around`, on which the arm passes through other postures."""
SHELF_DEPTH_M = 0.42
"""Distance that the base drives straight in with the arm stretched out, to reach into a fridge."""


IN_SPEED_M_S = 0.35
"""Speed of the base while it drives straight in."""
OUT_SPEED_M_S = 0.5
"""Speed of the base while it drives straight out."""
FAST_SPEED_M_S = 0.7
"""Speed of the base in both directions when few control steps are left."""
FAST_END_M = (0.04, 0.025)
"""When few control steps are left, a drive ends within the first distance of its goal, once the base moves less than
the second one per control step. The motion of the arm that follows corrects the remaining error."""
STUCK_STEPS = 6
"""Control steps without motion after which the base counts as blocked. `WorldView.link_forces` leaves out the
fingers."""
IN_CLEARANCE_M = 0.012
"""Clearance above which the arm keeps its planned configuration while the base drives in. It is
`workplace.CLEARANCES_M` of the first attempt."""
MAX_CORRECTION_RAD = 0.5
"""Largest change of a joint that corrects a lateral error of the base."""
BEFORE_SHELF_M = 1.5
"""Distance of a base pose in front of a shelf from what is on it."""


def inside_depth(view: WorldView, point: np.ndarray) -> float:
    """`SHELF_DEPTH_M` for a point (3,) on a shelf with something above it, 0 in the open."""
    for place in view.home.receptacles:
        if place.kind == "shelf" and -0.05 < point[2] - place.pos[2] < place.height:
            off = np.abs(place.local(point[:2]))
            # Beyond the edge, too: an object may stand out over it.
            if (off < np.array(place.half) + 0.08).all():
                return SHELF_DEPTH_M
    return 0.0


def shelf_heading(view: WorldView, point: np.ndarray) -> float:
    """Heading [rad] with which the shelf nearest to ``point`` (3,) is entered: square to its front, which is the one of
    its four sides that the robot is before."""
    place = min(
        (p for p in view.home.receptacles if p.kind == "shelf"),
        key=lambda p: float(np.linalg.norm(point - p.pos)),
    )
    toward = point[:2] - view.base[:2]
    turns = np.round((np.arctan2(toward[1], toward[0]) - place.yaw) / (np.pi / 2))
    return float(place.yaw + turns * np.pi / 2)


def shelf_start(view: WorldView, point: np.ndarray) -> np.ndarray | None:
    """Base pose (3,) straight before the shelf around ``point`` (3,), from which drives are counted by the rule.

    None without the rule, and where no shelf is: they are counted from where the robot is.
    """
    if not (follows_rule(view) and inside_depth(view, point)):
        return None
    yaw = shelf_heading(view, point)
    return np.array([*(point[:2] - BEFORE_SHELF_M * motion.ahead(yaw)), yaw])


@dataclass(frozen=True, eq=False)
class ReachIn:
    """An arm stretched out into furniture: configuration ``q`` (J,), pose ``pos`` (3,), ``rot`` (3, 3) of the hand."""

    q: np.ndarray
    pos: np.ndarray
    rot: np.ndarray


@phase("drive straight in")
def drive_in(
    view: WorldView, reach: ReachIn, boxes: Boxes, *, gripper: float, fast: bool = False
) -> Motion:
    """Drive straight ahead towards the base pose of a configuration, with the arm already stretched out.

    Lateral errors of the base are not steered away, because a turn would sweep the arm sideways. Where they would bring
    the arm too near to an obstacle, the arm corrects them before the drive.

    Args:
        view: world to act in.
        reach: configuration at the end of the drive, and the pose of the hand there.
        boxes: obstacles.
        gripper: gripper action, -1..1.
        fast: drive faster and accept a larger error at the end.

    Returns:
        Whether the base arrived; False when it is blocked.
    """
    near, slow = FAST_END_M if fast else (0.02, 0.006)
    # Before the drive: inside there is no room for corrections.
    goal = _lined_up(view, reach, boxes)
    yield from motion.move_joints(
        view, goal, gripper=gripper, tolerance=0.05, max_steps=12
    )
    heading = float(goal[2])
    pressed = 0
    still = 0
    last = view.q
    for step in range(80):
        q = view.q
        ahead = motion.ahead(heading)
        left = float((goal[:2] - q[BASE_XY]) @ ahead)
        moved = float((q[BASE_XY] - last[:2]) @ ahead)
        # At rest as well: a base that still rolls would push the hand on.
        if left < near and abs(moved) < slow:
            return True
        pressed = pressed + 1 if view.link_forces.sum() > BLOCKED_FORCE_N else 0
        # At first the base only speeds up.
        still = still + 1 if step > STUCK_STEPS and moved < 0.002 else 0
        if pressed >= BLOCKED_STEPS or still >= STUCK_STEPS:
            return False
        wish = (
            min(FAST_SPEED_M_S, 5.0 * (left - 1.5 * moved))
            if fast
            else min(IN_SPEED_M_S, 3.0 * (left - 2.0 * moved))
        )
        pace = max(wish, 0.04 if left > 0.02 else 0.0)
        turn = float(np.clip(3.0 * wrap(heading - q[BASE_YAW]), -0.5, 0.5))
        last = q
        yield motion.action(view, goal, gripper=gripper, drive=(pace, turn))
    return False


@phase("drive straight out", "retract")
def drive_out(
    view: WorldView, distance: float, *, gripper: float, speed: float = OUT_SPEED_M_S
) -> Motion:
    """Drive straight backwards over ``distance`` [m] at up to ``speed`` [m/s] with the arm held.

    Returns:
        Whether the base arrived; False when it is blocked.
    """
    goal = view.q
    start = view.base[:2]
    heading = float(view.base[2])
    pressed = 0
    for step in range(40):
        left = distance - float(np.linalg.norm(view.base[:2] - start))
        if left < 0.04:
            return True
        pressed = pressed + 1 if view.link_forces.sum() > BLOCKED_FORCE_N else 0
        if pressed >= BLOCKED_STEPS:
            return False
        turn = float(np.clip(3.0 * wrap(heading - view.base[2]), -0.5, 0.5))
        # Slowly at first: a jerk would shift the object in the fingers.
        pace = min(speed, 0.15 + 0.1 * step, 0.1 + 3.0 * left)
        yield motion.action(view, goal, gripper=gripper, drive=(-pace, turn))
    return False


def _lined_up(view: WorldView, reach: ReachIn, boxes: Boxes) -> np.ndarray:
    """The configuration (J,) at the end of a straight drive from the present base pose.

    If the arm would come nearer than `IN_CLEARANCE_M` to an obstacle, and a small change of its joints that keeps the
    hand at its pose gives more clearance, the arm is changed.
    """
    goal = reach.q
    q = view.q
    robot = view.robot.chain
    ahead = motion.ahead(goal[2])
    distance = float((goal[:2] - q[BASE_XY]) @ ahead)
    end = goal.copy()
    end[:2] = q[BASE_XY] + ahead * distance
    if _clearance_in(view.robot, end, distance, boxes) > IN_CLEARANCE_M:
        return end
    found = ik.solve(
        robot,
        ik.TipGoals(
            reach.pos[None], reach.rot[None], ik.columns(robot, torso=False), goal
        ),
        end[None, None],
    )
    near = (
        found.ok[0, 0]
        and np.abs(found.q[0, 0] - end)[BASE.stop :].max() < MAX_CORRECTION_RAD
    )
    better = near and _clearance_in(
        view.robot, found.q[0, 0], distance, boxes
    ) > _clearance_in(view.robot, end, distance, boxes)
    return ik.unwind(robot, found.q[0, 0], q) if better else end


def _clearance_in(robot: Robot, goal: np.ndarray, distance: float, boxes: Boxes) -> float:
    """Least clearance [m] of the robot while its base drives the last ``distance`` [m] straight to ``goal`` (J,)."""
    q = np.repeat(goal[None], 6, axis=0)
    q[:, BASE_XY] -= np.linspace(0.0, distance, 6)[:, None] * motion.ahead(goal[2])
    return float(motion.spheres(robot).clearance(q, boxes).min())


@phase("bring the arm to rest", "retract")
def go_home(view: WorldView, obj: str, *, holding: bool = True) -> Motion:
    """Bring the arm to its rest pose; the base drives backwards as far as obstacles require.

    Args:
        view: world to act in.
        obj: name of the object that is held or was just released.
        holding: keep the fingers closed and count the object as part of the robot.

    Returns:
        Whether the arm is at rest; False when the object was lost.
    """
    gripper = motion.CLOSED if holding else motion.OPEN
    robot = motion.spheres(view.robot)
    if holding:
        robot = robot.with_held(*held_spheres(view, obj))
    # A blocked route is planned again from where it ended.
    for _ in range(3):
        route = plan_home(view, obj, robot, holding=holding)
        if route is None or (
            yield from follow(view, route, gripper=gripper, held=obj if holding else "")
        ):
            break
        if holding and not holds(view, obj):
            return False
    return (yield from motion.to_rest(view, gripper=gripper, max_steps=60))


@phase("bring the arm to rest on the way out", "retract")
def go_home_fast(view: WorldView, obj: str) -> Motion:
    """Bring the arm to rest while the base still drives out of a shelf, if one after the other takes too long and a
    collision-free way is found. Returns whether it set out; the object may be lost then."""
    takes = OUT_STEPS + HOME_DELAY * float(motion.steps_home(view.robot, view.q))
    # By the rule it always does, see `follows_rule`.
    if view.steps_left > takes and not follows_rule(view):
        return False
    robot = motion.spheres(view.robot).with_held(*held_spheres(view, obj))
    route = plan_home(view, obj, robot, holding=True, distances=OUT_DISTANCES_M)
    if route is None or route.clearance < 0.0:
        return False
    yield from follow(view, route, gripper=motion.CLOSED, held=obj)
    return True


def plan_home(
    view: WorldView,
    obj: str,
    robot: RobotSpheres,
    *,
    holding: bool,
    distances: tuple[float, ...] = BACK_DISTANCES_M,
) -> Route | None:
    """A collision-free route to the rest pose with the shortest drive backwards, else the one with the most clearance;
    None when there is none."""
    others, target = surroundings(view, obj, view.tcp_pose[:3])
    # An object that was put down is an obstacle like others.
    boxes = others if holding else type(others).join([others, target])
    now = view.q
    goal = motion.rest_goal(view)
    limits = limits_for(view) if holding else UNLIMITED
    cells = planner(view, shut=True)
    best: Route | None = None
    for back in distances:
        end = now[:3] - back * motion.ahead_3d(now[2])
        if back and cells.line_clearance(now[:2], end[None, :2])[0] < 0.26:
            break
        wish = RouteWish(margin_m=0.01, direction=-1, straight=True, limits=limits)
        route = plan_route(view, end, goal, robot, boxes, wish)
        if route is None:
            continue
        # The first is the one with the shortest drive.
        if route.clearance >= 0.0:
            return route
        if best is None or route.clearance > best.clearance:
            best = route
    # Paths around take longer: only what would shake the object loose is worth them.
    if holding and best is not None and best.clearance < MAX_DEFICIT_M:
        for back in AROUND_BACK_DISTANCES_M:
            end = now[:3] - back * motion.ahead_3d(now[2])
            around = plan_around(view, end, goal, robot, boxes, limits=limits)
            if around is not None and around.steps <= view.steps_left:
                return around
    return best
