"""Turning a box on a shelf by a push, so that the hand can grasp it from the front around its narrow side.

A box on a shelf cannot be grasped if its narrow sides, the only ones that fit between the fingers, face front and back:
the hand enters through the door and cannot put its fingers before and behind the box. So the hand first pushes one end
of the front side inwards, near the shelf. It points in the direction of the later grasp: at the end of the push it is
parallel to the box and does not block the rotation. The angle is chosen beforehand: for several angles, the pose of the
turned box is computed and its grasps are counted.
Lengths [m], angles [rad], world frame.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mjhab.core.boxes import Boxes, sphere_box_distance
from mjhab.core.rotations import (
    frame_from_axes,
    mat_from_quat,
    quat_from_axis_angle,
    quat_mul,
    wrap,
)
from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import WorldView
from mjhab.episodes.grasps.candidates import ObjectShape
from mjhab.experts.arm import ik, motion
from mjhab.experts.arm.motion import Motion
from mjhab.experts.base.route import BLOCKED_FORCE_N, follow
from mjhab.experts.phases import phase
from mjhab.experts.planning.carry import ReachIn, drive_in
from mjhab.experts.planning.reach import placements, settle_reach
from mjhab.experts.planning.workplace import (
    CLEARANCES_M,
    BasePlacement,
    HandGoals,
    ReachQuery,
    Scene,
)
from mjhab.robots.parts import Gripper

Graspable = Callable[[np.ndarray, float], int]
"""Function from a pose (7,) of the object and an additional clearance [m] to the number of collision-free grasps."""
TURNS_RAD = tuple(np.radians((20.0, 35.0, 50.0, 65.0)))
"""Angles by which the box may be turned, tried in this order."""
EXTRA_TURN_RAD = np.radians(7.0)
"""Angle by which a push is planned further than needed."""
ENOUGH_GRASPS = 16
"""The push ends when the box has this number of grasps, counted with the additional clearance TIGHTER_M. A push that
ended as soon as a plan with the arm existed left grasps that touched something: 10 instead of 12 of 16 pudding boxes
were picked (docs/experts.md)."""
TIGHTER_M = -0.008
"""Additional clearance of the grasps that `ENOUGH_GRASPS` counts; negative: less clearance than for a grasp."""
MIN_TURN_SHARE = 0.6
"""Fraction of the planned angle before which `ENOUGH_GRASPS` does not end a push."""
TURNED_SHARE = 0.4
"""Fraction of the planned angle beyond which the box counts as turned."""
MIN_UPRIGHT_COSINE = 0.97
"""Least cosine between an axis of the box and the vertical. 14 degrees."""
DEPTHS_M = (0.42, 0.3, 0.15)
"""Distances of the straight drive before the push, tried in this order."""
TILT_SINES = (0.25, 0.4, 0.55)
"""Sines of the angles by which the hand points down. Fingers near the shelf do not topple the box; a larger angle keeps
the wrist clear of the shelf."""
STRAIGHTER_RAD = np.radians((0.0, 10.0, 20.0, 30.0))
"""Angles between the directions of the hand in the push and in the later grasp; 0 is parallel."""
PUSH_SPEED_M_S = 0.35
"""Speed of the push inwards."""
MAX_ASIDE_M = 0.007
"""Largest motion of the hand along the box per control step."""
PUSH_TURN_RAD = 0.05
"""Largest turn of the hand back to its planned rotation per control step."""
MAX_PUSH_STEPS = 30
"""Control steps after which a push ends."""
MAX_PUSH_FORCE_N = 200.0
"""Contact force at which a push ends."""
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
    view: WorldView, obj: str, scene: Scene, inward: np.ndarray, graspable: Graspable
) -> Nudge | None:
    """The fastest push after which a box on a shelf can be grasped; None if no push is found.

    Args:
        inward: (2,) unit vector into the shelf.
    """
    pose = view.object_pose(obj)
    shape = view.object_shape(obj)
    if (
        shape.kind != "box"
        or np.abs(mat_from_quat(pose[3:])[2]).max() < MIN_UPRIGHT_COSINE
    ):
        return None
    for push in _pushes(pose, shape, scene, inward, graspable):
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
    i, j = _level_axes(rot)
    a = rot[:2, i] * shape.half[i]
    b = rot[:2, j] * shape.half[j]
    share = np.linspace(-1.0, 1.0, 41)[:, None]
    return np.concatenate([a + share * b, -a + share * b, b + share * a, -b + share * a])


def _level_axes(rot: np.ndarray) -> list[int]:
    """The two axes of a box that lie level."""
    up = int(np.argmax(np.abs(rot[2])))
    return [k for k in range(3) if k != up]


def _pushes(
    pose: np.ndarray,
    shape: ObjectShape,
    scene: Scene,
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
        rows = np.flatnonzero(np.abs(along - (along.max() - INSET_M)) < 0.004)
        push = _Push(line[rows[np.argmin(line[rows] @ inward)]], inward, outer, spin)
        for turn in TURNS_RAD:
            then = push.pose_after(pose, turn)
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


def _touches(shape: ObjectShape, pose: np.ndarray, scene: Scene) -> bool:
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
    i, j = _level_axes(rot)
    along = [
        rot[:2, b] @ inward
        for a, b in ((i, j), (j, i))
        if 2 * shape.half[a] < hand.opening
    ]
    return float(np.arccos(np.clip(np.abs(along).max(initial=0.0), 0.0, 1.0)))


def _corner(hand: Gripper, rot: np.ndarray, inward: np.ndarray) -> np.ndarray:
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
        for less in STRAIGHTER_RAD if share < 0.9 else ():
            yaw = float(np.clip(push.after - less, 0.15, 0.9))
            approach = np.array(
                [*(level * (np.cos(yaw) * push.inward + np.sin(yaw) * push.outer)), -tilt]
            )
            aside = np.array(
                [*(np.sin(yaw) * push.inward - np.cos(yaw) * push.outer), 0.0]
            )
            for flip in (1.0, -1.0):
                rot.append(frame_from_axes(approach, flip * aside))
                pos.append(
                    [*(centre + push.end - _corner(hand, rot[-1], push.inward)[:2]), z]
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


@phase("turn the object by a push")
def nudge(
    view: WorldView, obj: str, plan: Nudge, boxes: Boxes, graspable: Graspable
) -> Motion:
    """Drive there and push until the box can be grasped. Returns whether it turned."""
    placement = plan.placement
    goal = plan.placement.goal
    pos = plan.goals.pos[goal]
    rot = plan.goals.rot[goal]
    pre = plan.goals.pre[goal]
    arrived = yield from follow(view, placement.route, gripper=motion.OPEN)
    if not arrived and view.link_forces.sum() > BLOCKED_FORCE_N:
        return False
    reach = ReachIn(placement.pre, pre, rot)
    if plan.depth and not (
        yield from drive_in(view, reach, boxes, gripper=motion.OPEN, fast=True)
    ):
        return False
    joints = settle_reach(view, placement, np.stack([pre, pos]), rot)
    rest = placement.at if joints is None else joints[1]
    hand = _PushingHand(rot, float(pos[2]), rest)
    return (yield from _push(view, obj, plan, hand, graspable))


@dataclass(frozen=True, eq=False)
class _PushingHand:
    """How the hand pushes: rotation ``rot`` (3, 3) and ``height`` [m] of the tool centre; preferred posture ``rest``
    (J,)."""

    rot: np.ndarray
    height: float
    rest: np.ndarray


@phase("push one end of the object inwards")
def _push(
    view: WorldView, obj: str, plan: Nudge, hand: _PushingHand, graspable: Graspable
) -> Motion:
    """Push inwards, keeping to the end of the box as it turns. Returns whether the box turned."""
    start = mat_from_quat(view.object_pose(obj)[3:])
    end = _End.of(view, obj, plan)
    turn = 0.0
    for _ in range(MAX_PUSH_STEPS):
        yield _pushing(view, end.of_box(view.object_pose(obj)), plan, hand)
        pose = view.object_pose(obj)
        turn = _turn(start[:, end.along], mat_from_quat(pose[3:])[:, end.along])
        if view.link_forces.sum() > MAX_PUSH_FORCE_N:
            break
        turned = turn >= MIN_TURN_SHARE * plan.turn
        if turned and graspable(pose, TIGHTER_M) >= ENOUGH_GRASPS:
            break
    return bool(turn > TURNED_SHARE * plan.turn)


@dataclass(frozen=True)
class _End:
    """The pushed end of a box in its frame: axes and signed distances of its front side and of its end [m]."""

    front: int
    along: int
    to_front: float
    to_end: float

    @classmethod
    def of(cls, view: WorldView, obj: str, plan: Nudge) -> _End:
        """The end that a plan pushes, of the box as it stands before."""
        rot = mat_from_quat(view.object_pose(obj)[3:])
        half = view.object_type(obj).half
        front, along = sorted(
            _level_axes(rot), key=lambda k: -abs(float(rot[:2, k] @ plan.inward))
        )
        to_front = -np.sign(rot[:2, front] @ plan.inward) * half[front]
        to_end = np.sign(rot[:2, along] @ plan.outer) * (half[along] - INSET_M)
        return cls(front, along, float(to_front), float(to_end))

    def of_box(self, pose: np.ndarray) -> np.ndarray:
        """Position (2,) of the end of the box at ``pose`` (7,)."""
        rot = mat_from_quat(pose[3:])[:2]
        return (
            pose[:2]
            + self.to_end * rot[:, self.along]
            + self.to_front * rot[:, self.front]
        )


def _pushing(
    view: WorldView, end: np.ndarray, plan: Nudge, hand: _PushingHand
) -> np.ndarray:
    """Action (A,) that moves the hand inwards and sideways to the ``end`` (2,) of the box."""
    corner = _corner(view.robot.gripper, hand.rot, plan.inward)[:2]
    here, here_rot = motion.tcp(view)
    aside = np.clip((end - here[:2] - corner) @ plan.outer, -MAX_ASIDE_M, MAX_ASIDE_M)
    ahead = PUSH_SPEED_M_S * STEP_SECONDS
    aim = np.array([*(here[:2] + ahead * plan.inward + aside * plan.outer), hand.height])
    aim_rot = ik.straight_line(
        here[None], aim[None], here_rot[None], hand.rot[None], 1.0, PUSH_TURN_RAD
    )[1]
    dofs = ik.columns(view.robot.chain, torso=False)
    goals = ik.TipGoals(aim[None], aim_rot, dofs, hand.rest)
    return motion.hand_action(view, goals, gripper=motion.OPEN)


def _turn(before: np.ndarray, after: np.ndarray) -> float:
    """Angle between two directions (3,) seen from above."""
    return float(
        np.abs(wrap(np.arctan2(after[1], after[0]) - np.arctan2(before[1], before[0])))
    )
