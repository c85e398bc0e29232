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

from dataclasses import dataclass

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.rotations import (
    mat_from_quat,
    wrap,
)
from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.arm.motion import Motion
from mjhab.experts.base.route import BLOCKED_FORCE_N, follow
from mjhab.experts.phases import phase
from mjhab.experts.planning.carry import ReachIn, drive_in
from mjhab.experts.planning.reach import settle_reach
from mjhab.experts.skills.nudge_plans import (
    INSET_M,
    Graspable,
    Nudge,
    corner_of,
    level_axes,
)

ENOUGH_GRASPS = 16
"""The push ends when the box has this number of grasps, counted with the additional clearance TIGHTER_M. A push that
ended as soon as a plan with the arm existed left grasps that touched something: 10 instead of 12 of 16 pudding boxes
were picked (docs/results/experts.md)."""
TIGHTER_M = -0.008
"""Additional clearance of the grasps that `ENOUGH_GRASPS` counts; negative: less clearance than for a grasp."""
MIN_TURN_SHARE = 0.6
"""Fraction of the planned angle before which `ENOUGH_GRASPS` does not end a push."""
TURNED_SHARE = 0.4
"""Fraction of the planned angle beyond which the box counts as turned."""
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


@phase("turn the object by a push", "push")
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
    # A drive that ran out of time may still be near enough; one that is blocked is not.
    if not arrived and view.link_forces.sum() > BLOCKED_FORCE_N:
        return False
    reach = ReachIn(placement.pre, pre, rot)
    if plan.depth and not (
        yield from drive_in(view, reach, boxes, gripper=motion.OPEN, fast=True)
    ):
        return False
    joints = settle_reach(view, placement, np.stack([pre, pos]), rot)
    # Out of reach by a little the push may still work: the controller goes as near as it can.
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


@phase("push one end of the object inwards", "push")
def _push(
    view: WorldView, obj: str, plan: Nudge, hand: _PushingHand, graspable: Graspable
) -> Motion:
    """Push inwards, keeping to the end of the box as it turns. Returns whether the box turned."""
    start = mat_from_quat(view.object_pose(obj)[3:])
    # Determined once: as the box turns, another side could seem to be its front.
    end = _End.of(view, obj, plan)
    turn = 0.0
    for _ in range(MAX_PUSH_STEPS):
        yield _pushing(view, end.of_box(view.object_pose(obj)), plan, hand)
        pose = view.object_pose(obj)
        turn = _turn(start[:, end.along], mat_from_quat(pose[3:])[:, end.along])
        if view.link_forces.sum() > MAX_PUSH_FORCE_N:
            break
        # Counting grasps takes long: not before the box has turned most of the way.
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
            level_axes(rot), key=lambda k: -abs(float(rot[:2, k] @ plan.inward))
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
    corner = corner_of(view.robot.gripper, hand.rot, plan.inward)[:2]
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
