"""Script of Pick by a rule, see `by_rule`, and the entry point that chooses between rule and search.

Lengths [m], angles [rad], world frame unless said.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import numpy as np

from mjhab.core.rotations import mat_from_quat
from mjhab.envs.parts.world_view import WorldView
from mjhab.episodes.grasps.candidates import LyingObject, grasp_candidates
from mjhab.experts.arm import motion
from mjhab.experts.arm.motion import Motion
from mjhab.experts.phases import phase
from mjhab.experts.planning.carry import inside_depth
from mjhab.experts.skills import pick as search
from mjhab.experts.skills import pick_plans
from mjhab.experts.skills.by_rule import (
    STANDOFF_M,
    Drive,
    Funnel,
    Hands,
    RuledPlacement,
    find_placement,
    move_hand,
)
from mjhab.experts.style import follows_rule

MIN_CLEAR_M = 0.004
"""Least clearance between hand and neighbouring objects on the approach."""
SCORE_PRICE = 0.03
"""Angle that a difference of 1 in the grasp score is worth in the choice of a grasp."""
AT_GRASP_M = 0.012
"""Distance between tcp and grasp below which the fingers begin to close."""
NEAR_GRASP_M = 0.03
"""Distance between tcp and grasp below which closing fingers continue to close."""
BEGUN_M = 0.004
"""Distance of a finger from its open position above which it counts as closing."""
PRESSED_N = 0.4
"""Force on each finger above which the object counts as held."""
LIFT_M = 0.08
"""Height by which the object is lifted before the arm goes to rest."""
LIFT_STEP_M = 0.03
"""Motion of the hand per control step while it lifts."""


def pick(view: WorldView) -> Motion:
    """Pick up the object of the active subtask, by the rule or by a search as the style demands."""
    return (yield from (pick_by_rule(view) if follows_rule(view) else search.pick(view)))


@phase("pick up by the rule", "approach")
def pick_by_rule(view: WorldView) -> Motion:
    """Pick up the object of the active subtask by the rule; by a search on shelves and if the rule finds no grasp."""
    subtask = view.subtask
    assert subtask is not None
    obj = subtask.obj
    found = plan(view, obj)
    if found is None:
        return (yield from search.pick(view))
    placement, pos, rot = found
    follower = placement.follower()
    # From before the grasp: this is the one thing that the rule remembers.
    height = float(view.object_pose(obj)[2])
    while True:
        drive = follower.step(view.base)
        pose = view.object_pose(obj)
        # What the fingers feel decides, not what the script did: a policy sees no past.
        if (view.finger_forces(obj) > PRESSED_N).all():
            yield _carry(view, bool(pose[2] < height + LIFT_M), drive)
        elif placement.far(view):
            yield motion.action(
                view, motion.rest_goal(view), gripper=motion.OPEN, drive=drive
            )
        else:
            turned = mat_from_quat(pose[3:])
            # In the frame of the object, so that the hand follows one that was shoved.
            hand = turned @ rot
            funnel = Funnel(pose[:3] + turned @ pos, hand, hand[:, 0], placement.ready)
            yield _grasp(view, funnel, drive)


def _carry(view: WorldView, low: bool, drive: Drive) -> np.ndarray:
    """Action (A,) with a held object: lift it while it is ``low``, then move the arm to rest."""
    if not low:
        return motion.action(
            view, motion.rest_goal(view), gripper=motion.CLOSED, drive=drive
        )
    here, rot = motion.tcp(view)
    return move_hand(
        view, here + np.array([0.0, 0.0, LIFT_STEP_M]), rot, motion.CLOSED, drive, view.q
    )


def _grasp(view: WorldView, funnel: Funnel, drive: Drive) -> np.ndarray:
    """Action (A,) that moves the hand towards a grasp and closes the fingers there."""
    fingers = float(view.q[view.robot.columns.fingers].mean())
    # Two thresholds, because closing fingers move the object a little, and must not open again for that.
    begun = fingers < view.robot.limits.gripper[1] - BEGUN_M
    there = funnel.distance(view) < (NEAR_GRASP_M if begun else AT_GRASP_M)
    return funnel.step(view, motion.CLOSED if there else motion.OPEN, drive)


def plan(
    view: WorldView, obj: str
) -> tuple[RuledPlacement, np.ndarray, np.ndarray] | None:
    """Choose a base placement, and a grasp in the object's frame: tcp position (3,), rotation (3, 3); None if none."""
    pose = view.object_pose(obj)
    # A shelf needs the straight drive in, which the rule does not know.
    if inside_depth(view, pose[:3]):
        return None
    scene = pick_plans.scene_of(view, obj)
    every = grasp_candidates(
        LyingObject.of(view.object_shape(obj), pose, scene.support_z),
        neighbours=scene.beside.near(pose[:3], 0.5),
        gripper=view.robot.gripper,
        options=pick_plans.OPTIONS,
    )
    every = every.take(np.flatnonzero(every.clear >= MIN_CLEAR_M))
    # The arm must be able to lift the object from the same base pose.
    lifted = every.pos + np.array([0.0, 0.0, LIFT_M])
    before = every.pos - STANDOFF_M * every.rot[:, :, 0]
    hands = Hands(every.pos, every.rot, before, lifted, -SCORE_PRICE * every.score)
    placement = find_placement(view, scene, pose[:3], hands)
    if placement is None:
        return None
    turned = mat_from_quat(pose[3:])
    pos = turned.T @ (every.pos[placement.row] - pose[:3])
    return placement, pos, turned.T @ every.rot[placement.row]
