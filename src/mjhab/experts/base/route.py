"""Motions of base and arm at the same time; the volume that they sweep is checked for collisions before they start.

Lengths [m], angles [rad], world frame. Letters: T control steps, P way points, Q joints.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mjhab.core.joints import BASE
from mjhab.core.rotations import wrap
from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.arm.clearance import Boxes, RobotSpheres
from mjhab.experts.arm.held import holds
from mjhab.experts.arm.motion import Motion
from mjhab.experts.base.ajar import planner
from mjhab.experts.base.follower import BaseTrajectory, Follower, PathSegment
from mjhab.experts.base.limits import UNLIMITED, CommandLimits
from mjhab.experts.phases import phase
from mjhab.robots.robot import Robot

MARGIN_M = 0.015
"""Wanted clearance between the robot and obstacles along a route."""
SELF_CLEARANCE_M = 0.015
"""Wanted clearance between arm and trunk."""
DRIVE_ERROR_M = 0.03
"""Additional clearance while the base drives, because it deviates from the planned route. Routes are driven within 20
mm and 0.08 rad of the prediction (tests/experts/planning/test_carrying.py)."""
LOW_HEIGHT_M = 0.3
"""Obstacles below this height can touch the base only; the map already keeps the base clear of them."""
BLOCKED_FORCE_N = 60.0
"""Least contact force at which the robot counts as blocked."""
BLOCKED_STEPS = 4
"""Consecutive control steps with `BLOCKED_FORCE_N` after which a drive is given up."""
LOST_STEPS = 3
"""Consecutive control steps without contact after which a held object counts as lost."""
STALLED_STEPS = 10
STALLED_RAD = 0.02
"""Progress of the arm in STALLED_STEPS below which it counts as stuck, while the base stands."""
LOOKAHEADS_M = (0.30, 0.20, 0.10)
"""Candidates for the look-ahead distance of `Pilot`. Short ones follow corners more closely, long ones are faster."""
_SHARES = (0.35, 0.6, 0.8, 0.9)
"""Shares of the drive's duration after which the arm may start."""
SETTLED_RAD = 0.01
"""Distance [rad, m] from its goal within which arm and torso have arrived."""
TORSO_STEP_M = 0.04
"""Greatest motion of the torso in a control step; measured."""
TORSO_GAIN = 0.18
"""Share of a change of the torso's speed that takes place within one control step; measured."""
STANDING_M = 0.03
STARTING_STEPS = 8.0
"""A drive over less than the first distance is a turn; a longer one takes so many control steps to speed up and to
stop."""
PASSED_RAD = 0.08
"""Distance of the arm from an intermediate posture at which it goes on to the next one."""


@dataclass(frozen=True, eq=False)
class Route:
    """A planned motion of base and arm.

    Attributes:
        base: drive of the base, one segment.
        arm: (J,) configuration at the end, of which arm and torso count.
        delay: control step at which the arm starts its (last) motion.
        steps: predicted duration [control steps].
        clearance: smallest clearance along the route beyond the wanted one [m]; negative: a deficit.
        via: (V, J) intermediate postures of the arm, see `sampled`; None for a straight motion in joint space.
        carried: index in ``via`` of the posture that the arm keeps until the step ``delay``.
        lead: control step at which the base starts.
    """

    base: BaseTrajectory
    arm: np.ndarray
    delay: int
    steps: int
    clearance: float
    via: np.ndarray | None = None
    carried: int = 0
    lead: int = 0

    @property
    def segment(self) -> PathSegment:
        """The path of the base."""
        return self.base.segments[0]


@dataclass(frozen=True, eq=False)
class RouteWish:
    """Options of `plan_route`.

    Attributes:
        margin_m: wanted clearance [m].
        direction: 1 forwards, -1 backwards, 0 the quicker one.
        straight: drive on a straight line instead of around furniture.
        limits: limits on the base commands; `UNLIMITED` for an empty hand. With a held object the clearance of the base
            counts, too, because a collision of the base can shake the object loose.
    """

    margin_m: float = MARGIN_M
    direction: int = 0
    straight: bool = False
    limits: CommandLimits = UNLIMITED


USUAL_ROUTE = RouteWish()


def plan_route(
    view: WorldView,
    goal: np.ndarray,
    arm: np.ndarray,
    robot: RobotSpheres,
    boxes: Boxes,
    wish: RouteWish = USUAL_ROUTE,
) -> Route | None:
    """Plan the quickest collision-free route to a base pose with the arm in a configuration.

    The arm starts at once if the clearance suffices, otherwise later. If it does not suffice even with the arm
    unmoved during the whole drive, the route with the most clearance is returned; its ``clearance`` is then negative.

    Args:
        view: the world.
        goal: (3,) base pose x, y, yaw.
        arm: (J,) configuration at the end, of which arm and torso count.
        robot: spheres that move, with those of the held object.
        boxes: obstacles.
        wish: options.

    Returns:
        The route; None when furniture separates base and goal.
    """
    start = view.q
    base = drive_of(view, goal, wish)
    if base is None:
        return None
    poses = base.poses
    # First: distances to the boxes of a whole home would take most of the time.
    boxes = within_reach(boxes, np.stack([start[:2], goal[:2]]))
    before = float(robot.clearance(start[None], boxes)[0])
    own = _own_clearance(start, arm, robot)
    if wish.limits != UNLIMITED and not wish.straight:
        cells = planner(view).clearance_at(poses[:, :2])
        least = view.robot.footprint.narrow
        own = min(own, float(cells.min() - min(least, cells[0], cells[-1])))

    def at(share: float) -> Route:
        delay = round(share * len(poses))
        swept = _swept(view.robot, start, poses, arm, delay)
        # Some 40 samples bound the time of a check, whatever the length.
        some = np.arange(0, len(swept), max(1, len(swept) // 40))
        # While the base drives, it deviates from the prediction: more clearance is asked for.
        asked = np.minimum(
            np.where(some < len(poses) - 1, wish.margin_m + DRIVE_ERROR_M, wish.margin_m),
            # A robot that stands close to something cannot ask for more than it has.
            before - 0.004,
        )
        clearance = min(own, float((robot.clearance(swept[some], boxes) - asked).min()))
        return Route(base, arm, delay, len(swept), clearance)

    # The quickest: base and arm move together.
    early = at(0.0)
    if early.clearance >= 0.0 or len(poses) == 1:
        return early
    late = at(1.0)
    if late.clearance < 0.0:
        return max(early, late, key=lambda route: route.clearance)
    return next((route for route in map(at, _SHARES) if route.clearance >= 0.0), late)


def drive_of(
    view: WorldView, goal: np.ndarray, wish: RouteWish = USUAL_ROUTE
) -> BaseTrajectory | None:
    """Plan the drive of a route to base pose ``goal`` (3,), see `plan_route`; None when furniture is in between."""
    path = (
        np.stack([view.base[:2], goal[:2]])
        if wish.straight
        else _path_around(view, goal[:2])
    )
    if path is None:
        return None
    yaw = float(goal[2])
    segment = PathSegment(path, wish.direction or _direction(view.base, path, yaw), yaw)
    # On a straight line the look-ahead changes nothing.
    few = len(path) == 2 and (wish.straight or wish.limits == UNLIMITED)
    return _smoothest(view, segment, wish.limits, LOOKAHEADS_M[: 1 if few else None])


class DriveGuess(NamedTuple):
    """What `drive_steps` assumes.

    Attributes:
        speed: forward speed [m/s].
        rate: yaw rate [rad/s].
        backwards: distance up to which the base may drive backwards [m].
    """

    speed: float
    rate: float
    backwards: float


ROUTE_GUESS = DriveGuess(0.6, 2.0, 0.9)
LINK_GUESS = DriveGuess(0.55, 1.6, np.inf)
"""For routes of Pick and Place, and for drives to doors and drawers. Measured: with `ROUTE_GUESS` for both, 49 instead
of 51 of 56 episodes with a fridge door succeed (split val, episodes 0 to 13), as many with a drawer."""


def drive_steps(
    now: np.ndarray,
    poses: np.ndarray,
    length: np.ndarray | float = 0.0,
    guess: DriveGuess = ROUTE_GUESS,
) -> np.ndarray:
    """Estimate the control steps (B,) of a drive: a turn, a path, a turn.

    Args:
        now: (3,) present base pose x, y, yaw.
        poses: (B, 3) base poses to drive to.
        length: (B,) lengths of the paths [m]; the straight distance counts where they are shorter.
        guess: speeds that are assumed.
    """
    offset = poses[:, :2] - now[:2]
    far = np.linalg.norm(offset, axis=1)
    bearing = np.arctan2(offset[:, 1], offset[:, 0])
    turn = np.abs(wrap(bearing - now[2])) + np.abs(wrap(poses[:, 2] - bearing))
    # Driven backwards, both turns are supplements.
    turn = np.where(far < guess.backwards, np.minimum(turn, 2 * np.pi - turn), turn)
    turn = np.where(far < STANDING_M, np.abs(wrap(poses[:, 2] - now[2])), turn)
    length = np.where(np.isfinite(length), np.maximum(length, far), np.inf)
    steps = (length / guess.speed + turn / guess.rate) * (1.0 / STEP_SECONDS)
    return steps + np.where(far < STANDING_M, 0.0, STARTING_STEPS)


def _path_around(view: WorldView, goal: np.ndarray) -> np.ndarray | None:
    """Way points (P, 2) to ``goal`` (2,) around furniture and open doors and drawers; None if there is no path."""
    path = planner(view).plan(view.base[:2], goal)
    if path is not None and np.linalg.norm(path[-1] - goal) > 1e-6:
        path = np.concatenate([path, goal[None]])
    return path


@phase("drive and move the arm")
def follow(
    view: WorldView,
    route: Route,
    *,
    gripper: float,
    tolerance: float = 0.05,
    held: str = "",
) -> Motion:
    """Execute a route.

    Args:
        view: the world.
        route: the route.
        gripper: gripper command.
        tolerance: largest `motion.joint_gap` to the configuration at the end.
        held: name of the object in the hand, "" for none; the motion ends when the object is lost.

    Returns:
        Whether base and arm arrived; False when the robot is blocked or stuck, or the object is lost.
    """
    follower = Follower(route.base.segments, route.base.lookahead, route.base.limits)
    arm = _ArmWay(view.q, route)
    pressed = 0
    lost = 0
    arrived = False
    nearest_off = np.inf
    since = 0
    moving = motion.drives(view, route.segment.points[-1], route.segment.yaw)
    began = 0
    last = view.q
    # Two seconds more than planned; who is not there then is stuck.
    for step in range(route.steps + 40):
        speed = (0.0, 0.0)
        if step >= route.lead and moving:
            speed = follower.step(view.base)
        arrived = arrived or (step >= route.lead and (follower.arrived or not moving))
        goal = arm.goal(view, step, arrived)
        off = motion.joint_gap(view, route.arm)
        if arrived and off <= tolerance:
            return True
        nearest_off, since = (
            (off, step)
            if off < nearest_off - STALLED_RAD or not arrived or goal is not route.arm
            else (nearest_off, since)
        )
        # A joint at its limit, or an arm that presses against something, would use up the time.
        if step - since >= STALLED_STEPS:
            return False
        # The arm starts slowly from every intermediate posture: a jerk can shake out an object at the fingertips.
        began, last = (began, last) if np.array_equal(goal, last) else (step, goal)
        ramp = min(
            1.0,
            0.25 * (1 + step - min(step, route.delay if route.via is None else began)),
        )
        yield motion.action(view, goal, gripper=gripper, drive=speed, speed=ramp)
        # In a row: grazing an edge is no reason to give up.
        pressed = pressed + 1 if view.link_forces.sum() > BLOCKED_FORCE_N else 0
        lost = 0 if not held or holds(view, held) else lost + 1
        if pressed >= BLOCKED_STEPS or lost >= LOST_STEPS:
            return False
    return False


def drive_to(view: WorldView, goal: np.ndarray, *, gripper: float) -> Motion:
    """Drive the base around furniture to ``goal`` (3,) x, y [m], yaw [rad], with the arm in its present configuration.

    Returns whether the base arrived; False when there is no path, or the robot is blocked.
    """
    base = drive_of(view, goal, RouteWish(direction=1))
    if base is None:
        return False
    route = Route(base, view.q, 0, len(base.poses), 0.0)
    return (yield from follow(view, route, gripper=gripper))


class _ArmWay:
    """Sequence of goals of the arm while a route is executed, from configuration ``start`` (J,)."""

    def __init__(self, start: np.ndarray, route: Route) -> None:
        self._start = start
        self._route = route
        self._at = 0

    def goal(self, view: WorldView, step: int, arrived: bool) -> np.ndarray:
        """Goal configuration (J,) in control step ``step``; ``arrived``: the base has arrived."""
        via = self._route.via
        on_time = step >= self._route.delay or arrived
        if via is None:
            return self._route.arm if on_time else self._start
        while self._at < len(via) and (on_time or self._at != self._route.carried):
            if motion.joint_gap(view, via[self._at]) >= PASSED_RAD:
                return via[self._at]
            self._at += 1
        return via[self._at] if self._at < len(via) else self._route.arm


def _direction(pose: np.ndarray, path: np.ndarray, yaw: float) -> int:
    """Direction of a drive from ``pose`` (3,): -1 (backwards) only on short paths and when that takes less turning."""
    offset = path[1] - path[0]
    last = path[-1] - path[-2]
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    # A drive that short is a turn on the spot.
    if length < 0.03:
        return 1
    first = abs(wrap(np.arctan2(offset[1], offset[0]) - pose[2]))
    turn = float(first + abs(wrap(yaw - np.arctan2(last[1], last[0]))))
    # Backwards only where it saves a good part of a turn.
    return -1 if length < 1.0 and turn > np.pi + 0.3 else 1


def _smoothest(
    view: WorldView,
    segment: PathSegment,
    limits: CommandLimits,
    lookaheads: tuple[float, ...],
) -> BaseTrajectory:
    """Drive with the first look-ahead distance with enough clearance of the base, else with that with the most."""
    cells = planner(view)
    found: list[tuple[float, BaseTrajectory]] = []
    for lookahead in lookaheads:
        drive = BaseTrajectory.of(view.base, [segment], lookahead, limits)
        clearance = float(cells.clearance_at(drive.poses[:, :2]).min())
        found.append((clearance, drive))
        if clearance >= view.robot.footprint.narrow:
            break
    return max(found, key=lambda one: one[0])[1]


def _swept(
    robot: Robot, start: np.ndarray, poses: np.ndarray, arm: np.ndarray, delay: int
) -> np.ndarray:
    """Predicted configurations (T, Q) of a route, one per control step, until base and arm have arrived."""
    # The base has its own prediction.
    offset = arm - start
    offset[BASE] = 0.0
    columns = list(robot.arm_columns)
    torso = list(robot.torso_columns)
    delta = robot.limits.joint_delta
    arm_share = arm_gone(float(np.abs(offset[columns]).max()), delta)
    torso_share = torso_gone(float(np.abs(offset[torso]).max(initial=0.0)), delta)
    steps = np.arange(max(len(poses), delay + max(len(arm_share), len(torso_share))) + 1)
    gone = np.ones((len(steps), len(offset)))
    gone[:, columns] = arm_share[np.clip(steps - delay, 0, len(arm_share) - 1), None]
    gone[:, torso] = torso_share[np.clip(steps - delay, 0, len(torso_share) - 1), None]
    out = start + gone * offset
    out[:, BASE] = poses[np.minimum(steps, len(poses) - 1)]
    return out


def arm_gone(far: float, delta: float) -> np.ndarray:
    """Predict the share (T,) of a straight motion in joint space that the arm has covered after each control step.

    The prediction includes the slow start of `follow` and the deceleration before the end: while the base drives, an
    error of 0.1 rad is an error of about 0.1 m at the hand.

    Args:
        far: largest motion of a joint [rad].
        delta: change of a joint that an action of 1 commands [rad].
    """
    gone = [0.0]
    while far - gone[-1] > SETTLED_RAD:
        gone.append(
            gone[-1]
            + ik.ARM_STEP_RAD * min(1.0, 0.25 * len(gone), (far - gone[-1]) / delta)
        )
    return np.array([*gone, far]) / far if far > 0.0 else np.ones(1)


def torso_gone(far: float, delta: float) -> np.ndarray:
    """Predict as `arm_gone` for the torso (``far``, ``delta`` [m]), which accelerates slowly under the arm's weight."""
    gone = [0.0]
    speed = 0.0
    while far - gone[-1] > SETTLED_RAD:
        speed += TORSO_GAIN * (TORSO_STEP_M * min(1.0, (far - gone[-1]) / delta) - speed)
        gone.append(min(gone[-1] + speed, far))
    return np.array([*gone, far]) / far if far > 0.0 else np.ones(1)


def within_reach(boxes: Boxes, offset: np.ndarray) -> Boxes:
    """Boxes that the robot can touch near the straight line between two base positions ``offset`` (2, 2)."""
    middle = offset.mean(axis=0)
    far = float(np.linalg.norm(offset[1] - offset[0])) / 2
    # At the height of the arm, which reaches 1.35 m from the middle of the base.
    near = boxes.near(np.array([*middle, 0.9]), far + 1.35)
    return near.take(near.center[:, 2] + near.half.max(axis=1) > LOW_HEIGHT_M)


def _own_clearance(start: np.ndarray, arm: np.ndarray, robot: RobotSpheres) -> float:
    """Least clearance of the arm to the trunk between ``start`` and ``arm`` (J,), beyond `SELF_CLEARANCE_M`."""
    gap = robot.self_clearance(start + np.linspace(0.0, 1.0, 10)[:, None] * (arm - start))
    return float(gap.min() - min(SELF_CLEARANCE_M, gap[0] - 0.004))
