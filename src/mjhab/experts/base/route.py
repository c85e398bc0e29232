"""Motions of base and arm at the same time; the volume that they sweep is checked for collisions before they start.

Lengths [m], angles [rad], world frame. Letters: T control steps, P way points, Q joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.core.boxes import nearest_box_distance
from mjhab.core.joints import BASE
from mjhab.envs.parts.world_view import HomeShapes, WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.arm.clearance import Boxes, RobotSpheres
from mjhab.experts.arm.gentle import Care, eased
from mjhab.experts.arm.motion import Motion
from mjhab.experts.base.navigation import FloorClearance, Planner
from mjhab.experts.base.pilot import MAX_SPEED_M_S, Pilot, simulate
from mjhab.robots.kinematics import wrap
from mjhab.robots.robot import Robot

Array = np.ndarray
MARGIN_M = 0.015
"""Wanted clearance between the robot and obstacles along a route."""
SELF_CLEARANCE_M = 0.015
"""Wanted clearance between arm and trunk."""
DRIVE_ERROR_M = 0.03
"""Additional clearance while the base drives, because it deviates from the planned route."""
MIN_MAP_CLEARANCE_M = 0.27
"""Least clearance of the map cells that a route may use."""
LOW_HEIGHT_M = 0.3
"""Obstacles below this height can touch the base only; the map already keeps the base clear of them."""
OVERHANG_M = 0.05
"""The robot is narrower by this length at the height of drawers and doors than at its base."""
BLOCKED_FORCE_N = 60.0
"""Least contact force at which the robot counts as blocked."""
BLOCKED_STEPS = 4
LOST_STEPS = 3
STALLED_STEPS = 10
STALLED_RAD = 0.02
"""Progress of the arm in STALLED_STEPS below which it counts as stuck, while the base stands."""
LOOKAHEADS_M = (0.30, 0.20, 0.10)
"""Distances ahead at which the base may steer. Short ones keep to the way at corners, long ones are faster."""
_SHARES = (0.35, 0.6, 0.8, 0.9)
SETTLED_RAD = 0.01
"""Distance [rad, m] from its goal within which arm and torso have arrived."""
TORSO_STEP_M = 0.04
"""Greatest motion of the torso in a control step; measured."""
TORSO_GAIN = 0.18
"""Share of a change of the torso's speed that one control step makes; measured."""
PASSED_RAD = 0.08
"""Distance of the arm from a posture on its way at which it goes on to the next one."""


def planner(view: WorldView) -> Planner:
    """Path planner of the world's home that knows which doors and drawers stand open now."""
    ajar = {name: round(view.link_q(name), 1) for name in view.home.links}
    ajar_now = tuple((name, q) for name, q in ajar.items() if q > 0.05)
    if not ajar_now:
        return motion.planner(view.home)
    home = view.home
    return home.derived.get(("planner", ajar_now), lambda: _planner_with(home, ajar_now))


def _planner_with(home: HomeShapes, ajar: tuple[tuple[str, float], ...]) -> Planner:
    plain = motion.planner(home)
    boxes = Boxes.join([home.links[name].boxes(q) for name, q in ajar])
    nx, ny = plain.clearance.shape
    x = plain.origin[0] + (np.arange(nx) + 0.5) * plain.cell
    y = plain.origin[1] + (np.arange(ny) + 0.5) * plain.cell
    cells = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((nx, ny))], axis=-1).reshape(
        -1, 3
    )
    # Seen from above: doors and drawers stand upright, so that height plays no part.
    flat = Boxes(boxes.center * [1.0, 1.0, 0.0], boxes.half, boxes.rot)
    gap = nearest_box_distance(cells, flat).reshape(nx, ny) + OVERHANG_M
    clearance = np.minimum(plain.clearance, np.maximum(gap, 0.0))
    return Planner(
        FloorClearance(plain.origin, plain.cell, clearance),
        plain.radius,
        plain.comfort,
        plain.caution,
        plain.narrow,
    )


@dataclass(frozen=True, eq=False)
class Route:
    """A drive along ``path`` (P, 2) to ``yaw`` (see `Pilot`), the arm going to ``arm`` (J,) from step ``delay`` on.

    ``steps``: how long it should take; ``room``: least clearance on the way beyond what was asked for [m].
    ``via``: (V, J) postures that the arm passes one after the other, see `sampled`; it keeps the one with the index
    ``carried`` until the step ``delay``. The base starts at the step ``lead``. ``care``: how gently it drives.
    """

    path: Array
    yaw: float
    direction: int
    lookahead: float
    arm: Array
    delay: int
    steps: int
    room: float
    speed: float = MAX_SPEED_M_S
    via: Array | None = None
    carried: int = 0
    lead: int = 0
    care: Care | None = None


@dataclass(frozen=True, eq=False)
class RouteWish:
    """How a route should be.

    Attributes:
        margin_m: room wanted.
        direction: 1 forwards, -1 backwards, 0 whatever is quicker.
        straight: do not plan around furniture.
        care: how gently the base drives. Something is in the hand then, and a base that bumps into things loses it.
    """

    margin_m: float = MARGIN_M
    direction: int = 0
    straight: bool = False
    care: Care | None = None


USUAL_ROUTE = RouteWish()


def plan_route(
    view: WorldView,
    goal: Array,
    arm: Array,
    robot: RobotSpheres,
    boxes: Boxes,
    wish: RouteWish = USUAL_ROUTE,
) -> Route | None:
    """The quickest way to the base pose ``goal`` (3,) with the arm at ``arm`` (J,) that keeps clear of ``boxes``.

    The arm starts at once if there is room, otherwise later; when even the whole way with the arm as it is comes too
    close, the route with the most room is given: look at its ``room``. None when furniture cuts the goal off.

    Args:
        robot: what moves, the held object included.
        boxes: obstacles.
        wish: how it should be.
    """
    start = view.q
    care = wish.care
    found = drive_of(view, goal, wish.direction, wish.straight, care)
    if found is None:
        return None
    path, direction, lookahead, poses = found
    boxes = within_reach(boxes, np.stack([start[:2], goal[:2]]))
    before = float(robot.clearance(start[None], boxes)[0])
    own = _own_room(start, arm, robot)
    if care and not wish.straight:
        cells = planner(view).clearance_at(poses[:, :2])
        own = min(own, float(cells.min() - min(MIN_MAP_CLEARANCE_M, cells[0], cells[-1])))

    def at(share: float) -> Route:
        delay = round(share * len(poses))
        swept = _swept(view.robot, start, poses, arm, delay)
        some = np.arange(0, len(swept), max(1, len(swept) // 40))
        # While the base drives, the robot is only about where it is expected to be.
        asked = np.minimum(
            np.where(some < len(poses) - 1, wish.margin_m + DRIVE_ERROR_M, wish.margin_m),
            before - 0.004,
        )
        room = min(own, float((robot.clearance(swept[some], boxes) - asked).min()))
        return Route(
            path, float(goal[2]), direction, lookahead, arm, delay, len(swept), room, care=care
        )

    early = at(0.0)
    if early.room >= 0.0 or len(poses) == 1:
        return early
    late = at(1.0)
    if late.room < 0.0:
        return max(early, late, key=lambda route: route.room)
    return next((route for route in map(at, _SHARES) if route.room >= 0.0), late)


def drive_of(
    view: WorldView,
    goal: Array,
    direction: int = 0,
    straight: bool = False,
    care: Care | None = None,
) -> tuple[Array, int, float, Array] | None:
    """How to drive to the base pose ``goal`` (3,), see `plan_route`: way points (P, 2), direction, look-ahead, and the
    base poses (T, 3) that this should give, one per control step. None when furniture cuts the goal off."""
    path = np.stack([view.base[:2], goal[:2]]) if straight else _way(view, goal[:2])
    if path is None:
        return None
    direction = direction or _direction(view.base, path, float(goal[2]))
    few = LOOKAHEADS_M[:1] if len(path) == 2 and (straight or not care) else LOOKAHEADS_M
    return path, direction, *_smoothest(view, path, float(goal[2]), direction, care, few)


def drive_steps(now: Array, poses: Array, length: Array) -> Array:
    """Rough number (B,) of control steps to drive from ``now`` (3,) to poses (B, 3) over a ``length`` (B,)."""
    way = poses[:, :2] - now[:2]
    far = np.linalg.norm(way, axis=1)
    bearing = np.arctan2(way[:, 1], way[:, 0])
    first = np.abs(wrap(bearing - now[2]))
    last = np.abs(wrap(poses[:, 2] - bearing))
    turn = np.where(far < 0.9, np.minimum(first + last, 2 * np.pi - first - last), first + last)
    turn = np.where(far < 0.03, np.abs(wrap(poses[:, 2] - now[2])), turn)
    length = np.where(np.isfinite(length), np.maximum(length, far), np.inf)
    return 20.0 * (length / 0.6 + turn / 2.0) + np.where(far < 0.03, 0.0, 8.0)


def _way(view: WorldView, goal: Array) -> Array | None:
    """Way points (P, 2) to ``goal`` (2,) around furniture and what stands open."""
    path = planner(view).plan(view.base[:2], goal)
    if path is not None and np.linalg.norm(path[-1] - goal) > 1e-6:
        path = np.concatenate([path, goal[None]])
    return path


def follow(
    view: WorldView, route: Route, *, gripper: float, tolerance: float = 0.05, held: str = ""
) -> Motion:
    """Drive a route. Returns whether base and arm arrived; not when something is in the way.

    ``held``: the object in the hand. The drive ends when it is lost.
    """
    pilot = Pilot(route.path, route.yaw, route.direction, route.lookahead, route.speed)
    arm = _ArmWay(view.q, route)
    pressed = 0
    lost = 0
    arrived = False
    least = np.inf
    since = 0
    care = route.care
    moving = motion.drives(view, route.path[-1], route.yaw)
    before = (0.0, 0.0)
    began = 0
    last = view.q
    for step in range(route.steps + 40):
        forward = 0.0
        turn = 0.0
        done = step >= route.lead
        if done and moving and not arrived:
            forward, turn, done = pilot.step(view.base)
        arrived = arrived or done
        goal = arm.goal(view, step, arrived)
        off = motion.joint_gap(view, route.arm)
        if arrived and off <= tolerance:
            return True
        least, since = (
            (off, step)
            if off < least - STALLED_RAD or not arrived or goal is not route.arm
            else (least, since)
        )
        if step - since >= STALLED_STEPS:
            return False
        speed = (0.0, 0.0) if arrived else (forward, turn)
        before = speed = eased(speed, before, care) if care else speed
        # The arm starts gently, from every posture on its way anew: what hangs at the fingers' tips would fall out.
        began, last = (began, last) if np.array_equal(goal, last) else (step, goal)
        ramp = min(1.0, 0.25 * (1 + step - min(step, route.delay if route.via is None else began)))
        yield motion.action(view, goal, gripper=gripper, drive=speed, speed=ramp)
        pressed = pressed + 1 if view.link_forces.sum() > BLOCKED_FORCE_N else 0
        lost = 0 if not held or holds(view, held) else lost + 1
        if pressed >= BLOCKED_STEPS or lost >= LOST_STEPS:
            return False
    return False


class _ArmWay:
    """Where the arm goes while a route is driven, from configuration ``start`` (J,)."""

    def __init__(self, start: Array, route: Route) -> None:
        self._start = start
        self._route = route
        self._at = 0

    def goal(self, view: WorldView, step: int, arrived: bool) -> Array:
        """The configuration (J,) to go to in a control step."""
        via = self._route.via
        on_time = step >= self._route.delay or arrived
        if via is None:
            return self._route.arm if on_time else self._start
        while self._at < len(via) and (on_time or self._at != self._route.carried):
            if motion.joint_gap(view, via[self._at]) >= PASSED_RAD:
                return via[self._at]
            self._at += 1
        return via[self._at] if self._at < len(via) else self._route.arm


def holds(view: WorldView, obj: str) -> bool:
    """Whether the fingers press an object."""
    return bool((view.finger_forces(obj) > 0.1).any())


def _direction(pose: Array, path: Array, yaw: float) -> int:
    """Backwards only on short ways and when that takes less turning."""
    way = path[1] - path[0]
    last = path[-1] - path[-2]
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    if length < 0.03:
        return 1
    first = abs(wrap(np.arctan2(way[1], way[0]) - pose[2]))
    turn = float(first + abs(wrap(yaw - np.arctan2(last[1], last[0]))))
    return -1 if length < 1.0 and turn > np.pi + 0.3 else 1


def _smoothest(
    view: WorldView,
    path: Array,
    yaw: float,
    direction: int,
    care: Care | None,
    lookaheads: tuple[float, ...],
) -> tuple[float, Array]:
    """The quickest steering that keeps the base clear of furniture: look-ahead and base poses (T, 3)."""
    cells = planner(view)
    best: tuple[float, float, Array] | None = None
    for lookahead in lookaheads:
        poses = simulate(view.base, path, yaw, direction, lookahead, care)
        room = float(cells.clearance_at(poses[:, :2]).min())
        if best is None or room > best[0]:
            best = (room, lookahead, poses)
        if room >= MIN_MAP_CLEARANCE_M:
            break
    assert best is not None
    return best[1], best[2]


def _swept(robot: Robot, start: Array, poses: Array, arm: Array, delay: int) -> Array:
    """Configurations (T, Q), one per control step, until base and arm have arrived."""
    way = arm - start
    way[BASE] = 0.0
    columns = list(robot.arm_columns)
    torso = list(robot.torso_columns)
    delta = robot.limits.joint_delta
    arm_share = arm_gone(float(np.abs(way[columns]).max()), delta)
    torso_share = torso_gone(float(np.abs(way[torso]).max(initial=0.0)), delta)
    steps = np.arange(max(len(poses), delay + max(len(arm_share), len(torso_share))) + 1)
    gone = np.ones((len(steps), len(way)))
    gone[:, columns] = arm_share[np.clip(steps - delay, 0, len(arm_share) - 1), None]
    gone[:, torso] = torso_share[np.clip(steps - delay, 0, len(torso_share) - 1), None]
    out = start + gone * way
    out[:, BASE] = poses[np.minimum(steps, len(poses) - 1)]
    return out


def arm_gone(far: float, delta: float) -> Array:
    """Share (T,) of its way that the arm has gone after so many control steps, ``far`` [rad] the longest of a joint.

    ``delta``: change of a joint that an action of 1 asks for. It starts as `follow` lets it, and
    slows down before its end: with the base on the move, a tenth of a radian that it lags behind is a decimetre at the
    hand.
    """
    gone = [0.0]
    while far - gone[-1] > SETTLED_RAD:
        gone.append(
            gone[-1] + ik.ARM_STEP_RAD * min(1.0, 0.25 * len(gone), (far - gone[-1]) / delta)
        )
    return np.array([*gone, far]) / far if far > 0.0 else np.ones(1)


def torso_gone(far: float, delta: float) -> Array:
    """The same for the torso, ``far`` [m]. It carries the arm and gathers speed slowly."""
    gone = [0.0]
    speed = 0.0
    while far - gone[-1] > SETTLED_RAD:
        speed += TORSO_GAIN * (TORSO_STEP_M * min(1.0, (far - gone[-1]) / delta) - speed)
        gone.append(min(gone[-1] + speed, far))
    return np.array([*gone, far]) / far if far > 0.0 else np.ones(1)


def within_reach(boxes: Boxes, way: Array) -> Boxes:
    """The boxes that the robot can touch somewhere near a straight way (2, 2)."""
    middle = way.mean(axis=0)
    far = float(np.linalg.norm(way[1] - way[0])) / 2
    near = boxes.near(np.array([*middle, 0.9]), far + 1.35)
    return near.take(near.center[:, 2] + near.half.max(axis=1) > LOW_HEIGHT_M)


def _own_room(start: Array, arm: Array, robot: RobotSpheres) -> float:
    """Least distance of the arm to the trunk on the way from ``start`` to ``arm`` (J,), beyond the one that is due."""
    gap = robot.self_clearance(start + np.linspace(0.0, 1.0, 10)[:, None] * (arm - start))
    return float(gap.min() - min(SELF_CLEARANCE_M, gap[0] - 0.004))
