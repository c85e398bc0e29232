"""Plans of pushes that turn a box on a shelf, see `nudge`: which end, by what angle, from which base pose.

Lengths [m], angles [rad], world frame.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mjhab.core.boxes import sphere_box_distance
from mjhab.core.rotations import (
    frame_from_axes,
    mat_from_quat,
    quat_from_axis_angle,
    quat_mul,
)
from mjhab.envs.parts.world_view import WorldView
from mjhab.episodes.grasps.candidates import ObjectShape
from mjhab.experts.planning.reach import placements
from mjhab.experts.planning.workplace import (
    CLEARANCES_M,
    BasePlacement,
    HandGoals,
    ReachQuery,
    ReachScene,
)
from mjhab.robots.parts import Gripper

Graspable = Callable[[np.ndarray, float], int]
"""Function from a pose (7,) of the object and an additional clearance [m] to the number of collision-free grasps."""
TURNS_RAD = tuple(np.radians((20.0, 35.0, 50.0, 65.0)))
"""Angles by which the box may be turned, tried in this order."""
EXTRA_TURN_RAD = np.radians(7.0)
"""Angle by which a push is planned further than needed."""
MIN_UPRIGHT_COSINE = 0.97
"""Least cosine between an axis of the box and the vertical. 14 degrees."""
DEPTHS_M = (0.42, 0.3, 0.15)
"""Distances of the straight drive before the push, tried in this order."""
TILT_SINES = (0.25, 0.4, 0.55)
"""Sines of the angles by which the hand points down. Fingers near the shelf do not topple the box; a larger angle keeps
the wrist clear of the shelf."""
STRAIGHTER_RAD = np.radians((0.0, 10.0, 20.0, 30.0))
"""Angles between the directions of the hand in the push and in the later grasp; 0 is parallel."""
INSET_M = 0.012
"""Distance of the push from the end of the box."""
START_GAP_M = 0.03
"""Distance before the box at which the push begins."""
FLOOR_GAP_M = 0.008
"""Clearance of the fingers above the shelf."""
_SPIN = 0.52
"""Lever of the friction below a turning box as a fraction of its half diagonal: about the mean distance of its bottom
from the centre."""
PUSH_CLEARANCES_M = ((CLEARANCES_M[0], 0.01), (CLEARANCES_M[2], 0.02))
"""Clearance of the arm, and how much nearer the hand may come, in the first and in the second search: a hand that
pushes is close to the shelf by intention."""
_MAX_DEFICIT_M = -0.03
"""Routes with less clearance than this are refused; negative: up to this deficit is accepted."""


@dataclass(frozen=True, eq=False)
class Nudge:
    """A planned push.

    Attributes:
        placement: reaches one of ``goals``.
        goals: hand poses at the end of the longest possible push.
        depth: distance of the straight drive before the push [m].
        turn: planned angle of the box [rad].
        inward, outer: (2,) unit vectors into the shelf and from the centre of the box to the pushed end.
    """

    placement: BasePlacement
    goals: HandGoals
    depth: float
    turn: float
    inward: np.ndarray
    outer: np.ndarray


@dataclass(frozen=True, eq=False)
class _Push:
    """A push of one end of a box.

    end: (2,) pushed point relative to the centre of the box [m]. inward, outer: as in `Nudge`. spin: lever of the
    friction below the box [m]. turn: angle by which the push turns the box [rad]. after: angle between ``inward`` and
    the direction of the later grasp [rad]. grasps: number of grasps of the turned box.
    """

    end: np.ndarray
    inward: np.ndarray
    outer: np.ndarray
    spin: float
    turn: float = 0.0
    after: float = 0.0
    grasps: int = 0

    @property
    def radius(self) -> float:
        """Distance from the pushed end to the centre of rotation [m]."""
        # Near the middle the centre of rotation would move to infinity, and the push would not turn the box at all.
        lever = max(float(self.end @ self.outer), 0.02)
        return lever + self.spin**2 / lever

    def pose_after(self, pose: np.ndarray, turn: float) -> np.ndarray:
        """Pose (7,) of the box after a rotation by ``turn`` [rad]."""
        beyond = self.radius - max(float(self.end @ self.outer), 0.02)
        out = pose.copy()
        out[:2] += beyond * (np.sin(turn) * self.inward)
        sign = np.sign(self.outer[0] * self.inward[1] - self.outer[1] * self.inward[0])
        out[3:] = quat_mul(
            quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(sign * turn)),
            pose[3:],
        )
        return out


def plan_nudge(
    view: WorldView, obj: str, scene: ReachScene, inward: np.ndarray, graspable: Graspable
) -> Nudge | None:
    """The fastest push after which a box on a shelf can be grasped; None if no push is found.

    Args:
        inward: (2,) unit vector into the shelf.
    """
    pose = view.object_pose(obj)
    shape = view.object_shape(obj)
    # Only boxes that stand: a tilted one would topple, and round objects do not turn.
    if (
        shape.kind != "box"
        or np.abs(mat_from_quat(pose[3:])[2]).max() < MIN_UPRIGHT_COSINE
    ):
        return None
    for push in _pushes(pose, shape, scene, inward, graspable):
        # The origin of an object is its centre.
        height = 2.0 * (pose[2] - scene.support_z)
        goals = _goals(view.robot.gripper, push, pose[:2], scene.support_z, height)
        for clearance, nearer in PUSH_CLEARANCES_M if len(goals) else ():
            query = ReachQuery(
                point=pose[:3],
                goals=goals,
                scene=scene,
                clearance=clearance,
                nearer=nearer,
            )
            found = _quickest(view, query)
            if found is not None:
                return Nudge(*found, push.turn, inward, push.outer)
    return None


def _quickest(
    view: WorldView, query: ReachQuery
) -> tuple[BasePlacement, HandGoals, float] | None:
    """The base placement, hand poses and drive of `DEPTHS_M` that are soonest done; None if the hand gets to none."""
    found = []
    for depth in DEPTHS_M:
        for placement in placements(view, replace(query, drive_in=depth)):
            if placement.route.clearance > _MAX_DEFICIT_M:
                steps = in_steps(depth) + placement.route.steps
                found.append((steps, placement, depth))
    if not found:
        return None
    _, placement, depth = min(found, key=lambda one: one[0])
    return placement, query.goals, depth


def in_steps(depth: float) -> float:
    """Control steps to come straight in over a ``depth`` in haste."""
    return 7.0 + 35.0 * depth if depth else 0.0


def outline(shape: ObjectShape, rot: np.ndarray) -> np.ndarray:
    """Outline (164, 2) of a box as it stands, seen from above, relative to its centre."""
    i, j = level_axes(rot)
    a = rot[:2, i] * shape.half[i]
    b = rot[:2, j] * shape.half[j]
    # Points instead of edges, so that the distance to boxes is that of spheres.
    share = np.linspace(-1.0, 1.0, 41)[:, None]
    return np.concatenate([a + share * b, -a + share * b, b + share * a, -b + share * a])


def level_axes(rot: np.ndarray) -> list[int]:
    """The two axes of a box that lie level."""
    up = int(np.argmax(np.abs(rot[2])))
    return [k for k in range(3) if k != up]


def _pushes(
    pose: np.ndarray,
    shape: ObjectShape,
    scene: ReachScene,
    inward: np.ndarray,
    graspable: Graspable,
) -> list[_Push]:
    """For either end the smallest turn after which it can be grasped, the smaller one first."""
    line = outline(shape, mat_from_quat(pose[3:]))
    across = np.array([-inward[1], inward[0]])
    found = []
    spin = _SPIN * float(np.linalg.norm(line, axis=1).max())
    for outer in (-across, across):
        along = line @ outer
        # The outline is sampled, so that no point lies exactly at the inset.
        rows = np.flatnonzero(np.abs(along - (along.max() - INSET_M)) < 0.004)
        push = _Push(line[rows[np.argmin(line[rows] @ inward)]], inward, outer, spin)
        for turn in TURNS_RAD:
            then = push.pose_after(pose, turn)
            # A larger turn would touch it, too.
            if _touches(shape, then, scene):
                break
            if count := graspable(then, 0.0):
                found.append(
                    _Push(
                        push.end,
                        inward,
                        outer,
                        spin,
                        turn + EXTRA_TURN_RAD,
                        _angle(scene.body.gripper, shape, then, inward),
                        count,
                    )
                )
                break
    return sorted(found, key=lambda push: (push.turn, -push.grasps))


def _touches(shape: ObjectShape, pose: np.ndarray, scene: ReachScene) -> bool:
    """Whether a box at a pose would be where something else is."""
    boxes = scene.beside.near(pose[:3], 0.5)
    half = pose[2] - scene.support_z
    edge = pose[:2] + 0.96 * outline(shape, mat_from_quat(pose[3:]))[::4]
    points = [
        np.column_stack([edge, np.full(len(edge), pose[2] + h * half)])
        for h in (-0.8, 0.0, 0.9)
    ]
    return bool(
        len(boxes) and sphere_box_distance(np.concatenate(points), boxes).min() < 0.004
    )


def _angle(
    hand: Gripper, shape: ObjectShape, pose: np.ndarray, inward: np.ndarray
) -> float:
    """Angle between the way in and the level axis along which the hand gets around a box at a pose."""
    rot = mat_from_quat(pose[3:])
    i, j = level_axes(rot)
    along = [
        rot[:2, b] @ inward
        for a, b in ((i, j), (j, i))
        # Only a side that fits between the fingers can be grasped.
        if 2 * shape.half[a] < hand.opening
    ]
    return float(np.arccos(np.clip(np.abs(along).max(initial=0.0), 0.0, 1.0)))


def corner_of(hand: Gripper, rot: np.ndarray, inward: np.ndarray) -> np.ndarray:
    """The fingertip corner (3,) of the open hand that is furthest in, relative to the tool centre."""
    side = np.sign(rot[:2, 1] @ inward)
    return (
        hand.finger[0] * rot[:, 0]
        + (hand.opening / 2 + hand.thickness) * side * rot[:, 1]
    )


def _goals(
    hand: Gripper, push: _Push, centre: np.ndarray, floor: float, height: float
) -> HandGoals:
    """Hand poses at the end of a push, on a shelf at ``floor``, of a box of some ``height``."""
    # The push ends by what is seen: the hand must be able to go further than planned.
    max_turn = min(push.turn + 0.25, 1.2)
    travel = (push.radius * np.sin(max_turn) + 0.02) * push.inward
    travel = travel - 0.2 * push.radius * (1.0 - np.cos(max_turn)) * push.outer
    pos = []
    rot = []
    score = []
    for tilt in TILT_SINES:
        level = np.sqrt(1.0 - tilt**2)
        fingers = -hand.finger[0] * tilt - hand.finger[1] * level
        palm = -hand.palm_x[1] * tilt - hand.palm_half[1] * level
        z = floor + FLOOR_GAP_M - min(fingers, palm)
        share = (z - hand.finger[0] * tilt - floor) / height
        # A hand near the top of the box would slide over it.
        for less in STRAIGHTER_RAD if share < 0.9 else ():
            yaw = float(np.clip(push.after - less, 0.15, 0.9))
            approach = np.array(
                [*(level * (np.cos(yaw) * push.inward + np.sin(yaw) * push.outer)), -tilt]
            )
            aside = np.array(
                [*(np.sin(yaw) * push.inward - np.cos(yaw) * push.outer), 0.0]
            )
            # The gripper is symmetric: half a turn gives the arm another posture for the same push.
            for flip in (1.0, -1.0):
                rot.append(frame_from_axes(approach, flip * aside))
                pos.append(
                    [*(centre + push.end - corner_of(hand, rot[-1], push.inward)[:2]), z]
                )
                score.append(-2.0 * max(share - 0.2, 0.0) - 0.5 * less)
    at = np.array(pos).reshape(-1, 3)
    ahead = np.array([*push.inward, 0.0])
    opening = np.full(len(at), hand.opening)
    return HandGoals(
        at + np.array([*travel, 0.0]),
        np.array(rot).reshape(-1, 3, 3),
        at - START_GAP_M * ahead,
        opening,
        np.array(score),
    )
