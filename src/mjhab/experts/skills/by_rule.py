"""Common part of Pick and Place by a rule: choice of base placement and hand pose, and a feedback law for the hand.

The action of such a script depends on the observable state and hardly on the past. A policy imitates it better than a
search, which chooses one of many base placements, hand poses and paths: where demonstrations in the same situation
differ, a policy learns their mean. The base placement is the nearest base pose from which the place is straight ahead
at a fixed distance. The hand pose is the one nearest to the hand's orientation at rest. The hand approaches within a
funnel: the farther it is beside the straight line to its goal, the farther it stays back.

Lengths [m], angles [rad], world frame. Letters: G hand poses, P way points, J joints.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mjhab.core.joints import BASE, BASE_XY
from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.base.ajar import planner
from mjhab.experts.base.follower import Follower, PathSegment
from mjhab.experts.base.limits import UNLIMITED, CommandLimits
from mjhab.experts.planning.reach import clear_ones
from mjhab.experts.planning.workplace import ReachScene

Drive = tuple[float, float]
"""Forward speed [m/s] and yaw rate [rad/s] of the base."""
DISTANCES_M = (0.78, 0.74, 0.82, 0.70, 0.86, 0.66)
"""Candidates for the distance between base and place, best first."""
BEARINGS = 36
"""Number of directions around the place that are tried."""
DISTANCE_PRICE = 4.0
"""Cost of a deviation from the best distance, in metres of driving per metre."""
MAX_PLACEMENTS = 40
"""Greatest number of base poses that are tried."""
LOOKAHEAD_M = 0.3
"""Look-ahead distance of the follower."""
PLACEMENT_CLEARANCE_M = 0.01
"""Clearance of a base placement beyond what the base needs to drive."""
PATH_END_M = 0.02
"""Greatest distance between a base placement and the end of the planned path to it."""
PITCH = np.deg2rad(60.0)
"""Preferred angle of the hand below the horizontal, that of the hand at rest."""
ROLL_WEIGHT = 0.5
"""Weight of the angle between the closing direction and the robot's left, relative to the angle to `PITCH`."""
MAX_GOALS = 12
"""Number of hand poses at a base placement for which inverse kinematics is solved."""
MIN_CLEARANCE_M = 0.0
"""Least clearance of the arm at the hand pose."""
ARM_FROM_M = 0.35
"""Distance between base and base placement below which the arm leaves its rest position."""
STANDOFF_M = 0.12
"""Greatest distance that the hand keeps from its goal along the approach direction."""
FUNNEL_SLOPE = 4.0
"""Distance kept from the goal per distance beside the approach line."""
FUNNEL_TURN_M = 0.25
"""Distance kept from the goal per angle between the hand and its goal [m/rad]."""
FREE_ASIDE_M = 0.006
FREE_TURN = 0.06
"""Distance beside the approach line [m] and angle [rad] below which the hand does not stay back."""
REACH_SPEED_M_S = 0.5
NEAR_SPEED_M_S = 0.25
"""Speeds of the tcp farther than, and within, `STANDOFF_M` from its goal."""
TURN_SPEED_RAD_S = 1.5
"""Rotation speed of the hand."""


@dataclass(frozen=True, eq=False)
class RuledPlacement:
    """A base pose from which a hand pose is reached.

    Attributes:
        base: (3,) base pose x, y, yaw.
        path: (P, 2) way points to it.
        row: index of the hand pose in `Hands`.
        ready: (J,) configuration with the hand at the pose before it.
    """

    base: np.ndarray
    path: np.ndarray
    row: int
    ready: np.ndarray

    def follower(self, limits: CommandLimits = UNLIMITED) -> Follower:
        """Make the controller that drives the base there."""
        segment = PathSegment(self.path, 1, float(self.base[2]))
        return Follower([segment], LOOKAHEAD_M, limits)

    def far(self, view: WorldView) -> bool:
        """Whether the base is still too far away for the arm to leave its rest position."""
        return float(np.linalg.norm(view.base[:2] - self.base[BASE_XY])) > ARM_FROM_M


@dataclass(frozen=True, eq=False)
class Hands:
    """Candidate hand poses in the world.

    Attributes:
        pos: (G, 3) tcp positions.
        rot: (G, 3, 3) rotations.
        before: (G, 3) tcp positions before them, with the same rotation.
        after: (G, 3) tcp positions after them, with the same rotation.
        price: (G,) cost that is added to the angles [rad] between the poses and the preferred orientation.
    """

    pos: np.ndarray
    rot: np.ndarray
    before: np.ndarray
    after: np.ndarray
    price: np.ndarray


def find_placement(
    view: WorldView, scene: ReachScene, point: np.ndarray, hands: Hands
) -> RuledPlacement | None:
    """Find the nearest base placement from which one of the hand poses is reached.

    Args:
        view: the world.
        scene: obstacles of the arm.
        point: (3,) place that the robot faces.
        hands: candidate hand poses.

    Returns:
        The base placement; None if no hand pose is reached from any base pose.
    """
    if not len(hands.pos):
        return None
    # Doors and drawers count as shut, so that the choice depends on the place and hardly on the state of the furniture.
    floor = planner(view, shut=True)
    for base in _bases(view, point):
        found = _nearest_to_rest(view, scene, base, hands)
        if found is None:
            continue
        path = floor.plan(view.base[:2], base[:2])
        if path is not None and np.linalg.norm(path[-1] - base[:2]) < PATH_END_M:
            return RuledPlacement(base, path, *found)
    return None


def _bases(view: WorldView, point: np.ndarray) -> Iterator[np.ndarray]:
    """Generate base poses (3,) that face ``point`` (3,), in order of increasing cost of the drive to them."""
    angles = np.linspace(-np.pi, np.pi, BEARINGS, endpoint=False)
    yaw, distance = (
        grid.ravel() for grid in np.meshgrid(angles, DISTANCES_M, indexing="ij")
    )
    xy = point[:2] - distance[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    # The same map as for the drive: a base pose that is free here but not there could not be reached.
    floor = planner(view, shut=True)
    cost = floor.costs(view.base[:2])[floor.grid.cells(xy)]
    cost = cost + DISTANCE_PRICE * np.abs(distance - DISTANCES_M[0])
    cost[floor.clearance_at(xy) < floor.radius + PLACEMENT_CLEARANCE_M] = np.inf
    # Stable, because unreachable cells all cost the same: an unstable order could differ between machines.
    order = np.argsort(cost, kind="stable")[:MAX_PLACEMENTS]
    for k in order[np.isfinite(cost[order])]:
        yield np.array([*xy[k], yaw[k]])


def _nearest_to_rest(
    view: WorldView, scene: ReachScene, base: np.ndarray, hands: Hands
) -> tuple[int, np.ndarray] | None:
    """Find the collision-free hand pose at base pose ``base`` (3,) that is nearest to the preferred orientation.

    Returns:
        Index of the hand pose and the configuration (J,) before it; None if none is reached.
    """
    ahead = motion.ahead_3d(base[2])
    down = np.array([0.0, 0.0, -1.0])
    left = np.array([-ahead[1], ahead[0], 0.0])
    rot = hands.rot
    lean = _angles(rot[:, :, 0], np.cos(PITCH) * ahead + np.sin(PITCH) * down)
    roll = _angles(rot[:, :, 1], left)
    # Stable: symmetric hands have equal prices, and the same one must win on every machine.
    rows = np.argsort(lean + ROLL_WEIGHT * roll + hands.price, kind="stable")[:MAX_GOALS]
    q = view.robot.rest.copy()
    q[BASE] = base
    chain = view.robot.chain
    seeds = np.repeat(q[None], len(rows), axis=0)[:, None]
    ready: dict[int, np.ndarray] = {}
    # Each solution starts from the one before, so that one motion of the arm leads through all three.
    for pos in (hands.before, hands.pos, hands.after):
        found = ik.solve(
            chain, ik.TipGoals(pos[rows], rot[rows], ik.columns(chain), q), seeds
        )
        good = np.flatnonzero(found.ok[:, 0])
        good = good[clear_ones(found.q[good, 0], scene, MIN_CLEARANCE_M)]
        rows = rows[good]
        seeds = found.q[good]
        # The arm begins from the posture before the goal, not from the last one of the three.
        ready = ready or dict(zip(rows.tolist(), seeds[:, 0], strict=True))
        if not len(rows):
            return None
    row = int(rows[0])
    return row, ready[row]


def _angles(axes: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Angles (G,) [rad] between unit vectors ``axes`` (G, 3) and ``wanted`` (3,)."""
    # Rounding can bring the product of unit vectors beyond 1, for which arccos is not defined.
    return np.arccos(np.clip(axes @ wanted, -1.0, 1.0))


@dataclass(frozen=True, eq=False)
class Funnel:
    """Feedback law that moves the hand to a pose along an approach line.

    Attributes:
        pos: (3,) goal position of the tcp in the world.
        rot: (3, 3) goal rotation.
        approach: (3,) unit vector of the approach direction.
        ready: (J,) posture preferred in the null space.
    """

    pos: np.ndarray
    rot: np.ndarray
    approach: np.ndarray
    ready: np.ndarray

    def distance(self, view: WorldView) -> float:
        """Distance [m] of the tcp from the goal position."""
        return float(np.linalg.norm(motion.tcp(view)[0] - self.pos))

    def turn(self, view: WorldView) -> float:
        """Angle [rad] between the hand and the goal rotation."""
        return motion.angle_between(motion.tcp(view)[1], self.rot)

    def step(self, view: WorldView, gripper: float, drive: Drive) -> np.ndarray:
        """Action (A,) that moves the hand towards the goal while the base drives."""
        here, here_rot = motion.tcp(view)
        off = here - self.pos
        aside = float(np.linalg.norm(off - (off @ self.approach) * self.approach))
        # The hand comes close only while it is on its line and turned well: a policy that is off it withdraws by
        # itself.
        back = FUNNEL_SLOPE * max(aside - FREE_ASIDE_M, 0.0)
        back += FUNNEL_TURN_M * max(self.turn(view) - FREE_TURN, 0.0)
        near = float(np.linalg.norm(off)) < STANDOFF_M
        aim, aim_rot = ik.straight_line(
            here[None],
            (self.pos - min(back, STANDOFF_M) * self.approach)[None],
            here_rot[None],
            self.rot[None],
            (NEAR_SPEED_M_S if near else REACH_SPEED_M_S) * STEP_SECONDS,
            TURN_SPEED_RAD_S * STEP_SECONDS,
        )
        return move_hand(view, aim[0], aim_rot[0], gripper, drive, self.ready)


def move_hand(
    view: WorldView,
    pos: np.ndarray,
    rot: np.ndarray,
    gripper: float,
    drive: Drive,
    posture: np.ndarray,
) -> np.ndarray:
    """Compute the action (A,) that moves the tcp to a pose nearby while the base drives.

    Args:
        view: the world.
        pos: (3,) tcp position in the world [m].
        rot: (3, 3) tcp rotation in the world.
        gripper: gripper command.
        drive: forward speed [m/s] and yaw rate [rad/s] of the base; the arm compensates them.
        posture: (J,) posture preferred in the null space.
    """
    chain = view.robot.chain
    # Joints without limits may be a whole turn away from the posture: without this the arm would turn back.
    rest = ik.unwind(chain, posture, view.q)
    goals = ik.TipGoals(pos[None], rot[None], ik.columns(chain), rest)
    return motion.hand_action(view, goals, gripper=gripper, drive=drive)
