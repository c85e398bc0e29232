"""What Pick and Place by a rule share: a stance, a hand pose there, and a funnel that leads the hand to it.

What such a script does next depends on what can be observed, hardly on what it did before. A policy can imitate that
better than a search, which chooses one of many stances, hand poses and ways: where demonstrations in the same
situation differ, a policy learns their mean. The stance is the nearest one from which the place lies at a fixed
distance ahead; the hand pose is the one nearest to how the hand is held at rest; and the farther the hand is beside the
straight way to it, the farther it stays back.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mjhab.core.joints import BASE, BASE_XY
from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.base.pilot import Pilot
from mjhab.experts.planning.reach import clear_ones
from mjhab.experts.planning.workplace import Scene

Array = np.ndarray
Drive = tuple[float, float]
"""Forward speed [m/s] and yaw rate [rad/s] of the base."""
DISTANCES_M = (0.78, 0.74, 0.82, 0.70, 0.86, 0.66)
"""Distances between the base and the place, most wanted first."""
BEARINGS = 36
"""Number of directions around the place that are tried."""
DISTANCE_PRICE = 4.0
"""Driving [m] that a metre off the most wanted distance is worth."""
MAX_STANCES = 40
LOOKAHEAD_M = 0.3
STANCE_ROOM_M = 0.01
"""Room that a stance has beyond what the base needs to drive."""
PATH_END_M = 0.02
"""Greatest distance between a stance and the end of the way to it."""
PITCH = np.deg2rad(60.0)
"""Angle below the horizontal at which the hand points at rest, and at the place where it can choose."""
ROLL_WEIGHT = 0.5
"""Weight of the angle between the fingers' line and the left-right line, against that between hand and `PITCH`."""
MAX_GOALS = 12
"""Number of hand poses that inverse kinematics is asked for at a stance."""
LEAST_ROOM_M = 0.0
"""Least clearance of the arm at the hand pose."""
ARM_FROM_M = 0.35
"""The arm reaches out when the base is nearer than this to its stance."""
STANDOFF_M = 0.12
"""Greatest distance that the hand keeps from its goal."""
FUNNEL_SLOPE = 4.0
"""Distance kept from the goal per distance beside the straight way to it."""
FUNNEL_TURN_M = 0.25
"""Distance kept from the goal per angle of the hand [m/rad]."""
FREE_ASIDE_M = 0.006
FREE_TURN = 0.06
"""Distance beside the straight way [m] and angle [rad] that do not keep the hand back."""
SERVO = ik.ServoOptions(rest_gain=0.02)
REACH_SPEED_M_S = 0.5
NEAR_SPEED_M_S = 0.25
"""Speeds of the hand farther and nearer than `STANDOFF_M` from its goal."""
TURN_SPEED_RAD_S = 1.5


@dataclass(frozen=True, eq=False)
class Stance:
    """Base pose ``base`` (3,), the way ``path`` (P, 2) to it, the row of the hand pose that is taken there, and the
    configuration ``ready`` (J,) with the hand `STANDOFF_M` before it."""

    base: Array
    path: Array
    row: int
    ready: Array

    def pilot(self) -> Pilot:
        """What drives the base there."""
        return Pilot(self.path, float(self.base[2]), 1, LOOKAHEAD_M)

    def far(self, view: WorldView) -> bool:
        """Whether the base has to come nearer before the arm reaches out."""
        return float(np.linalg.norm(view.base[:2] - self.base[BASE_XY])) > ARM_FROM_M


@dataclass(frozen=True, eq=False)
class Hands:
    """Hand poses ``pos`` (G, 3), ``rot`` (G, 3, 3), where the hand is ``before`` and ``after`` them (G, 3) without
    turning, and a ``price`` (G,) that is added to the angles [rad] by which they differ from the wanted one."""

    pos: Array
    rot: Array
    before: Array
    after: Array
    price: Array


def find_stance(view: WorldView, scene: Scene, point: Array, hands: Hands) -> Stance | None:
    """The stance for one of the hand poses around a ``point`` (3,)."""
    if not len(hands.pos):
        return None
    planner = motion.planner(view.home)
    for base in _bases(view, point):
        found = _nearest_to_rest(view, scene, base, hands)
        if found is None:
            continue
        path = planner.plan(view.base[:2], base[:2])
        if path is not None and np.linalg.norm(path[-1] - base[:2]) < PATH_END_M:
            return Stance(base, path, *found)
    return None


def _bases(view: WorldView, point: Array) -> Iterator[Array]:
    """Base poses (3,) that face a point, cheapest first."""
    angles = np.linspace(-np.pi, np.pi, BEARINGS, endpoint=False)
    yaw, distance = (grid.ravel() for grid in np.meshgrid(angles, DISTANCES_M, indexing="ij"))
    xy = point[:2] - distance[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    planner = motion.planner(view.home)
    cost = planner.costs(view.base[:2])[planner.cells(xy)]
    cost = cost + DISTANCE_PRICE * np.abs(distance - DISTANCES_M[0])
    cost[planner.clearance_at(xy) < planner.radius + STANCE_ROOM_M] = np.inf
    order = np.argsort(cost, kind="stable")[:MAX_STANCES]
    for k in order[np.isfinite(cost[order])]:
        yield np.array([*xy[k], yaw[k]])


def _nearest_to_rest(
    view: WorldView, scene: Scene, base: Array, hands: Hands
) -> tuple[int, Array] | None:
    """Row of the hand pose nearest to the hand at rest that is reached from a base pose (3,) without a collision, and
    the configuration (J,) before it."""
    ahead = np.array([np.cos(base[2]), np.sin(base[2]), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    left = np.array([-ahead[1], ahead[0], 0.0])
    rot = hands.rot
    lean = _angles(rot[:, :, 0], np.cos(PITCH) * ahead + np.sin(PITCH) * down)
    roll = _angles(rot[:, :, 1], left)
    rows = np.argsort(lean + ROLL_WEIGHT * roll + hands.price, kind="stable")[:MAX_GOALS]
    q = view.robot.rest.copy()
    q[BASE] = base
    chain = view.robot.chain
    seeds = np.repeat(q[None], len(rows), axis=0)[:, None]
    ready: dict[int, Array] = {}
    for pos in (hands.before, hands.pos, hands.after):
        found = ik.solve(chain, pos[rows], rot[rows], seeds, ik.columns(chain), rest=q)
        good = np.flatnonzero(found.ok[:, 0])
        good = good[clear_ones(found.q[good, 0], scene, LEAST_ROOM_M)]
        rows = rows[good]
        seeds = found.q[good]
        ready = ready or dict(zip(rows.tolist(), seeds[:, 0], strict=True))
        if not len(rows):
            return None
    row = int(rows[0])
    return row, ready[row]


def _angles(axes: Array, wanted: Array) -> Array:
    return np.arccos(np.clip(axes @ wanted, -1.0, 1.0))


@dataclass(frozen=True, eq=False)
class Funnel:
    """A way to a hand pose ``pos`` (3,), ``rot`` (3, 3) that ends along ``approach`` (3,), a unit vector.

    ``ready`` (J,): posture that the arm prefers.
    """

    pos: Array
    rot: Array
    approach: Array
    ready: Array

    def distance(self, view: WorldView) -> float:
        """Distance of the tool centre from the pose [m]."""
        return float(np.linalg.norm(motion.tcp(view)[0] - self.pos))

    def turn(self, view: WorldView) -> float:
        """Angle of the hand to the pose [rad]."""
        return motion.angle_between(motion.tcp(view)[1], self.rot)

    def step(self, view: WorldView, gripper: float, drive: Drive) -> Array:
        """The action (A,) that brings the hand nearer."""
        here, here_rot = motion.tcp(view)
        off = here - self.pos
        aside = float(np.linalg.norm(off - (off @ self.approach) * self.approach))
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
    view: WorldView, pos: Array, rot: Array, gripper: float, drive: Drive, posture: Array
) -> Array:
    """The action (A,) that brings the tool centre to a pose nearby while the base drives; ``posture`` (J,) is preferred
    in the null space."""
    chain = view.robot.chain
    delta = ik.servo(
        chain,
        view.q,
        pos[None],
        rot[None],
        ik.columns(chain),
        rest=ik.unwind(chain, posture, view.q),
        base_next=view.base[None] + motion.base_motion(view.base[2], drive),
        options=SERVO,
    )[0]
    return motion.action(view, view.q + delta / motion.ARM_STEP_SHARE, gripper=gripper, drive=drive)
