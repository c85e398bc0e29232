"""Script of the subtask Navigate: drive to where the next subtask takes place, with the arm at rest.

Lengths [m], angles [rad], world frame. Letters: N base poses, H headings, X, Y grid points.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np

from mjhab.core.joints import BASE_XY, BASE_YAW
from mjhab.core.rotations import wrap
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import motion
from mjhab.experts.arm.motion import Motion
from mjhab.experts.base.ajar import planner
from mjhab.experts.base.driving import plan_drive
from mjhab.experts.base.floorplan import Arm, Floorplan, turn_between
from mjhab.experts.base.follower import BaseTrajectory, Follower, PathSegment, turns
from mjhab.experts.base.lattice import YAWS, Lattice
from mjhab.experts.base.limits import DRIVE_FREE, DRIVE_HELD, eased
from mjhab.experts.base.route import BLOCKED_FORCE_N, BLOCKED_STEPS
from mjhab.experts.phases import phase
from mjhab.experts.planning.base_poses import in_sight
from mjhab.experts.planning.carry import inside_depth
from mjhab.experts.style import style_of
from mjhab.tasks.style import OPEN

WANTED_DISTANCE_M = 0.95
"""Preferred distance between base and goal, from which the next subtask needs little driving."""
MIN_DISTANCE_M = 0.65
"""Distance from the goal below which costs increase."""
LIMIT_MARGIN_M = 0.12
"""Margin to the limits of success at the end: to the greatest distance from the goal and to the edges of the area."""
MAX_GRID_BEARING_RAD = 0.3
"""Greatest bearing of the goal at the last lattice node; the base then turns to face the goal if there is room."""
SUPPORT_DISTANCE_M = 0.5
"""Furniture within this distance of the goal may be its support: it counts less as an occlusion."""
SLIMMER_M = ((0.0, 0.0), (0.015, 0.02), (0.03, 0.05))
"""Reductions of the safety margins of base and arm, tried in this order until a path is found. The last one leaves the
base 0.26 m, less than its radius: cells of the map are 0.05 m wide."""
DOOR_MOVED = 0.08
"""Change of a drawer or door [m or rad] after which the path is planned again."""
STUCK_STEPS = 15
STUCK_M = 0.02
"""Motion in STUCK_STEPS below which the robot counts as stuck."""
WORK_DISTANCES_M = (0.5, 0.95)
"""Least and greatest distance of the base from the goal in the next subtask."""
LONG_DETOUR_M = 1.5
"""Length of the path from the end pose to the next work place above which it is added to the cost."""
MAX_DETOUR_M = 20.0
"""Upper bound on that length in the cost."""
DETOUR_PRICE_S_M = 1.5
"""Cost per metre of that path."""
FELT_RADIUS_M = 0.12
"""Assumed radius of an unknown obstacle that the robot has touched."""


class Aim(NamedTuple):
    """Goal of a Navigate: the base faces a point from a distance.

    Attributes:
        point: (3,) point to face.
        distance: preferred distance between base and point.
        reach: greatest distance with which the subtask succeeds.
        area: (4,) x_min, x_max, y_min, y_max that the base must be in; None for no such area.
    """

    point: np.ndarray
    distance: float
    reach: float
    area: np.ndarray | None

    @classmethod
    def of(cls, view: WorldView) -> Aim:
        """Goal of the active subtask."""
        subtask = view.subtask
        assert subtask is not None
        point = np.array(subtask.goal_pos)
        # The base cannot enter furniture: its distance from a goal inside is longer by the depth.
        distance = WANTED_DISTANCE_M + inside_depth(view, point)
        area = view.front_area(subtask.link) if subtask.link else None
        return cls(
            point,
            distance,
            view.config.nav_distance,
            None if area is None else np.array(area),
        )

    def bearing(self, xy: np.ndarray) -> np.ndarray:
        """Heading (...,) [rad] that faces the goal from ``xy`` (..., 2)."""
        return np.arctan2(self.point[1] - xy[..., 1], self.point[0] - xy[..., 0])

    def allows(self, xy: np.ndarray, within: float) -> np.ndarray:
        """(...,) bool: ``xy`` (..., 2) is near enough and in the area, with a margin of ``within`` [m]."""
        good = np.linalg.norm(xy - self.point[:2], axis=-1) <= self.reach - within
        if self.area is not None:
            low = self.area[::2] + within
            high = self.area[1::2] - within
            good = good & ((xy >= low) & (xy <= high)).all(axis=-1)
        return good

    def price(self, lattice: Lattice, detour: np.ndarray) -> np.ndarray:
        """End cost (H, X, Y) [s] of each lattice node, infinite where the subtask would not succeed.

        ``detour`` (X, Y): see `detours`.
        """
        xy = lattice.points
        good = self.allows(xy, LIMIT_MARGIN_M)
        # In narrow rooms the margin may leave no place at all.
        if not good.any():
            good = self.allows(xy, 0.02)
        off = np.abs(wrap(YAWS[:, None, None] - self.bearing(xy)))
        out = np.full(lattice.shape, np.inf)
        far = np.linalg.norm(xy[good] - self.point[:2], axis=-1)
        pay = 4.0 * np.maximum(far - self.distance, 0.0) + 6.0 * np.maximum(
            MIN_DISTANCE_M - far, 0.0
        )
        pay = pay + 12.0 * (
            lattice.plan.hidden(xy[good], self.point, SUPPORT_DISTANCE_M) > 0.0
        )
        # With a short distance of tolerance the furniture that carries the goal hides it, too: a small price for
        # working across it.
        pay = pay + 3.0 * (lattice.plan.hidden(xy[good], self.point, 0.1) > 0.0)
        pay = pay + DETOUR_PRICE_S_M * detour[good]
        clearance = lattice.clearance[:, good]
        out[:, good] = np.where(
            # Nodes have few headings: what remains is turned in place at the end.
            off[:, good] <= MAX_GRID_BEARING_RAD,
            pay + 1.5 * off[:, good],
            np.inf,
        )
        out[:, good] += 10.0 * np.maximum(0.1 - clearance, 0.0)
        return out


@phase("navigate", "drive")
def navigate(view: WorldView) -> Motion:
    """Drive to the goal of the active subtask, face it and stand still; never ends by itself."""
    subtask = view.subtask
    assert subtask is not None
    held = subtask.obj if subtask.must_hold else ""
    gripper = motion.CLOSED if held else _empty_hand(view)
    posture = motion.rest_goal(view)
    felt = np.zeros((0, 3))
    aim = Aim.of(view)
    while True:
        yield motion.action(view, posture, gripper=gripper)
        # Planned anew after every stop, because doors and what was touched change the map.
        trajectory = plan_trajectory(view, aim, posture, held, felt)
        if trajectory is None:
            yield from motion.hold(view, 10, gripper=gripper, goal=posture)
            # What was felt is a guess: if it leaves no way it was wrong, or has moved.
            felt = felt[:0]
            continue
        met = yield from _drive(view, trajectory, posture, gripper)
        if met is not None:
            felt = np.concatenate([felt, met])
            yield from _back_off(view, posture, gripper, trajectory)
        elif _arrived(view, aim):
            yield from _stand(view, aim, posture, gripper)


def _empty_hand(view: WorldView) -> float:
    """Gripper command on the way: as at rest, or open where style and subtask have it.

    Drawn starts have the fingers of the rest posture. Policies that have seen these alone find no handle with an open
    hand; some of them pick more objects with it, and some fewer.
    """
    subtask = view.subtask
    assert subtask is not None
    to_link = subtask.link and subtask.toward == subtask.link
    if style_of(view).hand == OPEN and not to_link:
        return motion.OPEN
    return motion.gripper_at_rest(view.robot)


def detours(view: WorldView, aim: Aim, points: np.ndarray) -> np.ndarray:
    """Cost (X, Y) of the paths from ``points`` (X, Y, 2) to where the next subtask takes place, if they are long.

    A position can be near to the goal and yet need a long way around furniture to reach it by hand. The cost is in
    metres, weighted by clearance; 0 below `LONG_DETOUR_M`, and everywhere for goals inside furniture.
    """
    cells = planner(view)
    centres = cells.grid.centres
    far = np.linalg.norm(centres - aim.point[:2], axis=-1)
    work = (
        (cells.clearance >= cells.radius)
        & (far >= WORK_DISTANCES_M[0])
        & (far <= WORK_DISTANCES_M[1])
    )
    if aim.area is not None or inside_depth(view, aim.point) or not work.any():
        return np.zeros(points.shape[:2])
    # Around the height of a worktop, as far as a line of sight from a work place can reach.
    walls = view.home.boxes.near(np.array([*aim.point[:2], 0.9]), 2.0)
    work[work] = in_sight(centres[work], aim.point, walls)
    if not work.any():
        return np.zeros(points.shape[:2])
    length = cells.costs_to(work)[cells.grid.cells(points)]
    return np.where(length > LONG_DETOUR_M, np.minimum(length, MAX_DETOUR_M), 0.0)


def plan_trajectory(
    view: WorldView, aim: Aim, posture: np.ndarray, held: str, felt: np.ndarray
) -> BaseTrajectory | None:
    """Plan the drive with the least cost to a pose that faces the goal.

    Args:
        view: the world.
        aim: the goal.
        posture: (J,) configuration of the arm during the drive.
        held: name of the object in the hand, "" for none.
        felt: (B, 3) x, y, radius of unknown obstacles that the robot has touched.

    Returns:
        The drive; None when there is no path.
    """
    arm = Arm.of(view, posture, held)
    whole = Floorplan.of(view, arm, held, felt)
    # The widest margins first: a narrow path is a last resort, as the follower strays from it.
    for base, less in SLIMMER_M:
        plan = whole.slimmer(base, less)
        lattice = Lattice(plan)
        found = lattice.search(
            view.base, aim.price(lattice, detours(view, aim, lattice.points))
        )
        if found is not None:
            segments = _facing(plan, aim, view.base, found[1])
            return plan_drive(
                plan, view.base, segments, DRIVE_HELD if held else DRIVE_FREE
            )
    return None


def _facing(
    plan: Floorplan, aim: Aim, pose: np.ndarray, segments: list[PathSegment]
) -> list[PathSegment]:
    """Segments from ``pose`` (3,) with a final turn that faces the goal, where there is room for it."""
    end, yaw = (
        (segments[-1].points[-1], segments[-1].yaw)
        if segments
        else (pose[:2], float(pose[2]))
    )
    last = turn_between(yaw, float(aim.bearing(end)))
    return (
        [*segments, *turns(end, yaw, last)]
        if not segments or plan.turning(end, yaw, last) >= 0.0
        else segments
    )


@phase("drive", "drive")
def _drive(
    view: WorldView, trajectory: BaseTrajectory, posture: np.ndarray, gripper: float
) -> Generator[np.ndarray, None, np.ndarray | None]:
    """Drive the segments of a trajectory; end early when a door or drawer moves.

    Returns:
        (1, 3) x, y, radius of an unknown obstacle that stopped the robot; None if nothing did.
    """
    pressed = 0
    track = [view.base]
    tried = 0
    joints = _joints(view)
    follower = Follower(
        trajectory.segments,
        trajectory.lookahead,
        trajectory.limits,
        motion.base_speeds(view),
    )
    while (segment := follower.segment) is not None:
        forward, turn = follower.step(view.base)
        yield motion.action(view, posture, gripper=gripper, drive=(forward, turn))
        track.append(view.base)
        # A short touch need not stop a drive.
        pressed = pressed + 1 if view.link_forces.sum() > BLOCKED_FORCE_N else 0
        # Commands that small may leave the base where it is.
        tried = tried + 1 if abs(forward) > 0.05 or abs(turn) > 0.2 else 0
        if pressed >= BLOCKED_STEPS or (
            tried > STUCK_STEPS and _still(track[-STUCK_STEPS:])
        ):
            return _ahead(view, segment)
        # The map of free floor is another one now.
        if np.abs(_joints(view) - joints).max(initial=0.0) > DOOR_MOVED:
            return None
    return None


def _still(track: Sequence[np.ndarray]) -> bool:
    """Whether the first and the last of some base poses (3,) differ by less than `STUCK_M` [m, rad]."""
    moved = track[-1] - track[0]
    return bool(np.abs([*moved[:2], wrap(moved[2])]).max() < STUCK_M)


def _ahead(view: WorldView, segment: PathSegment) -> np.ndarray:
    """Assumed obstacle (1, 3) x, y, radius that stops the robot on a segment: in front of the base or of the hand."""
    q = view.q
    ahead = segment.direction * motion.ahead(q[BASE_YAW])
    # A contact of the arm is ahead of the hand, one of the base in front of its bumper.
    arm_felt = (
        segment.direction > 0
        and view.link_forces[list(view.robot.arm_force_rows)].sum()
        > 0.5 * view.link_forces.sum()
    )
    at = (
        view.tcp_pose[:2] + 0.15 * ahead
        if arm_felt
        else q[BASE_XY] + (0.3 + FELT_RADIUS_M) * ahead
    )
    return np.array([[*at, FELT_RADIUS_M]])


@phase("back off from an obstacle", "drive")
def _back_off(
    view: WorldView, posture: np.ndarray, gripper: float, trajectory: BaseTrajectory
) -> Motion:
    """Drive back for 14 control steps towards an earlier position of the trajectory."""
    q = view.q
    gap = np.linalg.norm(trajectory.poses[:, :2] - q[BASE_XY], axis=1)
    passed = trajectory.poses[: int(np.argmin(gap)) + 1] if len(gap) else trajectory.poses
    # Backing off to a point nearer than this would not clear the obstacle.
    away = passed[np.linalg.norm(passed[:, :2] - q[BASE_XY], axis=1) > 0.2]
    origin = away[-1, :2] if len(away) else q[BASE_XY] - 0.2 * motion.ahead(q[BASE_YAW])
    ahead = float((origin - q[BASE_XY]) @ motion.ahead(q[BASE_YAW]))
    speed, _ = motion.base_speeds(view)
    for _ in range(14):
        wish = (float(np.copysign(0.3, ahead)), 0.0)
        # A held object could be lost by a jerk after the contact.
        speed, _ = eased(wish, (speed, 0.0), trajectory.limits)
        yield motion.action(view, posture, gripper=gripper, drive=(speed, 0.0))
    return True


def _joints(view: WorldView) -> np.ndarray:
    """Joint positions of all doors and drawers."""
    return np.array([view.link_q(name) for name in view.home.links])


def _arrived(view: WorldView, aim: Aim) -> bool:
    """Whether the base faces the goal from an allowed position."""
    q = view.q
    facing = (
        abs(float(wrap(aim.bearing(q[BASE_XY]) - q[BASE_YAW])))
        # A small margin, because the base may still turn on after the last command.
        <= view.config.nav_bearing - 0.05
    )
    return bool(facing and aim.allows(q[BASE_XY], 0.0))


@phase("stand at the goal", "hold")
def _stand(view: WorldView, aim: Aim, posture: np.ndarray, gripper: float) -> Motion:
    """Stand still with the arm at rest while the base is at its goal. Returns when it no longer is."""
    while _arrived(view, aim):
        yield motion.action(view, posture, gripper=gripper)
    return False
