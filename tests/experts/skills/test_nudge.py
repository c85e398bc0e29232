"""Boxes on a shelf whose narrow side faces front and back: the push that turns them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import mjhab.envs as envs
from mjhab.core.boxes import Boxes
from mjhab.core.rotations import mat_from_quat
from mjhab.episodes.grasps.candidates import ObjectShape
from mjhab.experts import make_expert
from mjhab.experts.arm import motion
from mjhab.experts.planning.workplace import ReachScene
from mjhab.experts.skills import pick_plans
from mjhab.experts.skills.nudge_plans import (
    Graspable,
    _goals,
    _pushes,
    outline,
    plan_nudge,
)
from mjhab.robots.fetch.robot import ROBOT

BOX = ObjectShape("box", (0.036, 0.082, 0.107))
INWARD = np.array([1.0, 0.0])
ACROSS = np.array([0.0, 0.0, 0.107, 1.0, 0.0, 0.0, 0.0])
"""Its narrow axis points into the shelf."""


def shelf(*others: tuple[float, float, float]) -> ReachScene:
    """A bare shelf with cubes of 6 cm at some places."""
    boxes = Boxes.of(np.array(others).reshape(-1, 3), np.full((len(others), 3), 0.03))
    return ReachScene(boxes, Boxes.of(np.zeros((0, 3)), np.zeros((0, 3))), 0.0, ROBOT)


def turned_by(lower: float) -> Graspable:
    """Grasps from a turn [rad] on."""

    def graspable(pose: np.ndarray, more: float) -> int:
        x, y, _ = mat_from_quat(pose[3:])[:, 0]
        return 10 if abs(np.arctan2(y, x)) >= lower - more else 0

    return graspable


def test_outline_is_that_of_the_box_as_it_stands():
    edge = outline(BOX, np.eye(3))
    np.testing.assert_allclose(np.abs(edge).max(axis=0), BOX.half[:2])
    # It lies on its broad side.
    lying = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    np.testing.assert_allclose(
        np.abs(outline(BOX, lying)).max(axis=0), [BOX.half[2], BOX.half[1]], atol=1e-12
    )


def test_either_end_is_pushed_in_no_further_than_it_needs():
    pushes = _pushes(ACROSS, BOX, shelf(), INWARD, turned_by(np.radians(30.0)))
    assert len(pushes) == 2
    for push in pushes:
        assert np.degrees(push.turn) == pytest.approx(42.0)
        # Its front, near the end.
        np.testing.assert_allclose(
            [push.end[0], abs(push.end[1])], [-0.036, 0.070], atol=0.004
        )
        before = mat_from_quat(ACROSS[3:])
        after = mat_from_quat(push.pose_after(ACROSS, 0.6)[3:])
        corner = np.array([*push.end, 0.0]) @ before @ after.T
        assert corner[0] > push.end[0] + 0.03


def test_an_end_is_not_pushed_into_what_stands_behind_it():
    pushes = _pushes(
        ACROSS, BOX, shelf((0.09, 0.08, 0.03)), INWARD, turned_by(np.radians(30.0))
    )
    assert [float(push.outer[1]) for push in pushes] == [-1.0]


def test_the_hand_pushes_low_and_stays_above_the_shelf():
    push = _pushes(ACROSS, BOX, shelf(), INWARD, turned_by(np.radians(30.0)))[0]
    goals = _goals(ROBOT.gripper, push, np.zeros(2), 0.0, 0.214)
    assert len(goals)
    tips = goals.pos + ROBOT.gripper.finger[0] * goals.rot[:, :, 0]
    assert (tips[:, 2] > ROBOT.gripper.finger[1] * 0.9).all() and (
        tips[:, 2] < 0.05
    ).all()
    # It begins before the box and ends beyond where the front was.
    assert (goals.pre[:, 0] + ROBOT.gripper.finger[0] < -0.036).all() and (
        tips[:, 0] > -0.036
    ).all()


def test_only_boxes_that_stand_are_turned():
    view = SimpleNamespace(
        object_pose=lambda obj: np.array(
            [0.0, 0.0, 0.1, np.cos(0.3), np.sin(0.3), 0.0, 0.0]
        ),
        object_shape=lambda obj: BOX,
    )
    assert plan_nudge(view, "box", shelf(), INWARD, turned_by(0.0)) is None  # pyright: ignore[reportArgumentType]


def test_a_box_that_cannot_be_grasped_is_turned_and_stays_upright():
    env = envs.make(
        task="prepare_groceries",
        subtask="pick",
        target="003_cracker_box",
        num_envs=1,
        split="train",
        autoreset="disabled",
        threads=1,
    )
    obs, info = env.reset(seed=0, options={"episode": [11]})
    view = env.view(0)
    subtask = view.subtask
    assert subtask is not None
    obj = subtask.obj
    before = mat_from_quat(view.object_pose(obj)[3:])
    assert pick_plans.plan_pick(view, obj, np.zeros((0, 3))) is None
    assert pick_plans.scene_of(view, obj).support_z > 0.5
    expert = make_expert(env)
    expert.reset(np.ones(1, bool))
    turn = 0.0
    for _ in range(110):
        obs, _, _, _, info = env.step(expert.act(obs, info))
        assert view.link_forces.sum() < 400.0
        now = mat_from_quat(view.object_pose(obj)[3:])
        turn = float(np.degrees(np.arccos(np.clip(before[:, 0] @ now[:, 0], -1.0, 1.0))))
        if turn > 15.0:
            break
    # A hand that is itself turned to the sides of the box can grasp it after a small turn.
    assert turn > 15.0 and now[2, 2] > 0.95
    assert motion.joint_gap(view, motion.rest_goal(view)) > 0.1
