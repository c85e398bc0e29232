"""End effector modes: along which axes the gripper moves, how exactly, and where it must stop."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mjhab.core.conventions.hand_turns import (
    maniskill_angles,
    maniskill_turn,
    turns_for_maniskill,
)
from mjhab.core.rotations import mat_from_rotation_vector, rotation_vector
from mjhab.robots.controllers import CONTROL_MODES, make_controller
from mjhab.robots.fetch.model import REST_QPOS
from mjhab.robots.fetch.robot import ROBOT
from tests.robots.controllers.robot_bench import (
    ARM,
    BENT,
    REMEMBERING,
    WORLDS,
    Bench,
    bench,
    still_state,
)


def directions() -> np.ndarray:
    """Actions (8, 6): ±x, ±y, ±z, a turn about x, none."""
    rows = np.zeros((WORLDS, 6))
    for i in range(3):
        rows[2 * i, i] = 0.1
        rows[2 * i + 1, i] = -0.1
    rows[6, 3] = 0.2
    return rows


@pytest.mark.parametrize(
    "mode", [m for m in CONTROL_MODES if m.startswith("pd_ee_") and m != "pd_ee_pose"]
)
def test_end_effector_moves_along_its_frame(mode: str):
    b = bench(mode, yaw=1.0)
    pos, rot = b.tip()
    actions = b.controller.still(b.state)
    size = b.controller.gripper
    actions[:, :size] = directions()[:, :size]
    for _ in range(8):
        b.step(actions)
    b_pos, b_rot = b.tip()
    moved = b_pos - pos
    if "align" in mode:
        moved = np.einsum("wji,wj->wi", rot, moved)
    for world in range(6):
        along = directions()[world, :3] / 0.1
        assert moved[world] @ along > 0.02
        assert np.linalg.norm(moved[world] - (moved[world] @ along) * along) < 0.1 * (
            moved[world] @ along
        )
    np.testing.assert_allclose(moved[7], 0.0, atol=2e-4)
    if size == 6:
        turn = rotation_vector(b_rot @ rot.swapaxes(1, 2))
        about = rot[6, :, 0] if "align" in mode else np.array([1.0, 0.0, 0.0])
        if mode.endswith("_maniskill"):
            about = -about
        assert (
            turn[6] @ about > 0.03
            and np.linalg.norm(turn[6] - (turn[6] @ about) * about) < 0.01
        )
        assert np.linalg.norm(turn[:6], axis=1).max() < 0.01


@pytest.mark.parametrize(
    "mode", ["pd_ee_delta_pose", "pd_ee_delta_pose_align", "pd_ee_target_delta_pose"]
)
def test_one_command_of_the_end_effector_is_met_and_its_turn_clipped_by_norm(mode: str):
    state = still_state(6)
    controller = make_controller(mode, 6)
    controller.reset(np.ones(6, bool), state)
    pos, rot = ROBOT.arm_chain.tip_pose(state.robot_q[:, ARM])
    actions = np.random.default_rng(2).uniform(-0.4, 0.4, (6, controller.dim))
    actions[0, 3:6] = 1.0
    got_pos, got_rot = ROBOT.arm_chain.tip_pose(controller.ctrl(actions, state)[:, ARM])
    turn = (
        0.1
        * actions[:, 3:6]
        / np.maximum(np.linalg.norm(actions[:, 3:6], axis=1, keepdims=True), 1.0)
    )
    own = mode.endswith("align")
    move = 0.1 * actions[:, :3, None]
    np.testing.assert_allclose(
        got_pos, pos + (rot @ move if own else move)[..., 0], atol=2e-4
    )
    want = (
        rot @ mat_from_rotation_vector(turn)
        if own
        else mat_from_rotation_vector(turn) @ rot
    )
    np.testing.assert_allclose(
        rotation_vector(want @ got_rot.swapaxes(1, 2)), 0.0, atol=2e-3
    )
    assert np.linalg.norm(turn[0]) == pytest.approx(0.1)


@pytest.mark.parametrize(
    "mode", ["pd_ee_delta_pose_maniskill", "pd_ee_target_delta_pose_maniskill"]
)
def test_maniskills_hand_turns_backwards_by_three_angles(mode: str):
    """Its numbers are angles about x, y, z, and it scales them by -0.1 (ManiSkill#1469)."""
    state = still_state(6)
    controller = make_controller(mode, 6)
    controller.reset(np.ones(6, bool), state)
    pos, rot = ROBOT.arm_chain.tip_pose(state.robot_q[:, ARM])
    actions = np.zeros((6, controller.dim))
    actions[:3, 3:6] = np.eye(3)
    actions[3, 3:6] = (0.5, 0.6, 0.6)
    actions[4, 3:6] = (0.9, 0.9, 0.0)
    actions[5, :3] = 0.2
    got_pos, got_rot = ROBOT.arm_chain.tip_pose(controller.ctrl(actions, state)[:, ARM])
    turns = rotation_vector(got_rot @ rot.swapaxes(1, 2))
    np.testing.assert_allclose(turns[:3], -0.1 * np.eye(3), atol=2e-3)
    moved = np.full((6, 3), 0.0)
    moved[5] = 0.02
    np.testing.assert_allclose(got_pos - pos, moved, atol=2e-4)
    # Clipped by its length.
    assert np.linalg.norm(turns[4]) == pytest.approx(0.1, abs=2e-3)
    x, y, _ = -0.1 * actions[3, 3:6]
    order = [(x, 0, 0), (0, y, 0), (0, 0, y)]
    about_x, about_y, about_z = mat_from_rotation_vector(np.array(order))
    want = about_x @ about_y @ about_z @ rot[3]
    error = rotation_vector((want @ got_rot[3].T)[None])
    np.testing.assert_allclose(error, 0.0, atol=2e-3)


def test_turns_are_converted_to_maniskills_angles():
    vectors = np.random.default_rng(3).normal(size=(50, 3)) * 0.3
    turns = maniskill_turn(maniskill_angles(vectors))
    np.testing.assert_allclose(turns, mat_from_rotation_vector(vectors), atol=1e-12)
    # Small turns are the same numbers backwards.
    np.testing.assert_allclose(
        maniskill_angles(vectors * 1e-4), -vectors * 1e-4, atol=1e-8
    )


def test_an_exported_action_turns_the_hand_as_ours_did():
    """The hand of ManiSkill's mode, given converted numbers, goes where ours of the same name went."""
    state = still_state(6)
    ours = make_controller("pd_ee_delta_pose", 6)
    actions = np.zeros((6, ours.dim))
    actions[:, :6] = np.random.default_rng(4).uniform(-0.5, 0.5, (6, 6))
    converted = actions.copy()
    converted[:, 3:6] = turns_for_maniskill(actions[:, 3:6])
    poses = []
    for mode, given in (
        ("pd_ee_delta_pose", actions),
        ("pd_ee_delta_pose_maniskill", converted),
    ):
        controller = make_controller(mode, 6)
        controller.reset(np.ones(6, bool), state)
        poses.append(ROBOT.arm_chain.tip_pose(controller.ctrl(given, state)[:, ARM]))
    np.testing.assert_allclose(poses[0][0], poses[1][0], atol=1e-4)
    # The clip by length takes a little of the largest turns.
    np.testing.assert_allclose(poses[0][1], poses[1][1], atol=5e-4)
    assert np.abs(converted[:, 3:6] + actions[:, 3:6]).max() > 1e-3


def test_absolute_pose_far_away_is_approached_over_several_steps():
    state = still_state(1)
    goal = BENT.copy()
    goal[ARM] = BENT[ARM] + np.array([0.6, 0.5, -0.5, 0.4, 0.5, -0.5, 0.6])
    controller = make_controller("pd_ee_pose", 1)
    controller.reset(np.ones(1, bool), state)
    pos, rot = ROBOT.arm_chain.tip_pose(goal[ARM])
    actions = np.zeros((1, controller.dim))
    actions[:, :3] = pos
    actions[:, 3:6] = rotation_vector(rot)
    for _ in range(15):
        out = controller.ctrl(actions, state)
    got_pos, got_rot = ROBOT.arm_chain.tip_pose(out[:, ARM])
    np.testing.assert_allclose(got_pos, pos, atol=1e-4)
    np.testing.assert_allclose(got_rot, rot, atol=1e-3)


@pytest.mark.parametrize("mode", REMEMBERING[:4])
def test_targets_stay_within_the_joint_limits_and_do_not_wind_up(mode: str):
    state = still_state(4)
    controller = make_controller(mode, 4)
    controller.reset(np.ones(4, bool), state)
    actions = np.where(np.arange(4)[:, None] % 2, controller.high, controller.low)
    actions[2:, : controller.gripper : 2] *= -1
    low, high = np.array([ROBOT.joint_limits[j] for j in ARM]).T
    for _ in range(60):
        out = controller.ctrl(actions, state)[:, ARM]
        assert (out >= low - 1e-9).all() and (out <= high + 1e-9).all()
    if mode != "pd_ee_pose":
        back = controller.ctrl(-actions, state)[:, ARM]
        assert (np.abs(back - out).max(axis=1) > 0.01).all()


SIDE = 0.1


def square(time: float, speed: float) -> np.ndarray:
    """Point (2,) on a 10 cm square at a time [s] of one lap."""
    side, along = divmod(min(time * speed, 4 * SIDE - 1e-9), SIDE)
    return np.array(
        [(along, 0), (SIDE, along), (SIDE - along, SIDE), (0, SIDE - along)][int(side)]
    )


def absolute(
    b: Bench, want: np.ndarray, rot: np.ndarray, before: np.ndarray
) -> np.ndarray:
    return np.concatenate([want, rotation_vector(rot)], axis=1)


def from_target(
    b: Bench, want: np.ndarray, rot: np.ndarray, before: np.ndarray
) -> np.ndarray:
    return np.concatenate([(want - before) / 0.1, np.zeros_like(want)], axis=1)


def from_measured(
    b: Bench, want: np.ndarray, rot: np.ndarray, before: np.ndarray
) -> np.ndarray:
    pos, now = b.tip()
    # The servos cover 1 - exp(-kp/kd * 50 ms) of a change in one control step.
    return (
        np.concatenate([want - pos, rotation_vector(rot @ now.swapaxes(1, 2))], axis=1)
        / 0.1
        / 0.3935
    )


@pytest.mark.parametrize(
    ("mode", "command"),
    [
        ("pd_ee_pose", absolute),
        ("pd_ee_target_delta_pose", from_target),
        ("pd_ee_target_delta_pos", from_target),
        ("pd_ee_delta_pose", from_measured),
        ("pd_ee_delta_pos", from_measured),
    ],
)
def test_end_effector_tracks_a_square_within_5_mm(
    mode: str, command: Callable[..., np.ndarray]
):
    """4 cm/s at 20 Hz from the rest pose; every world another square: planes xy, yz, xz, all turned four ways.

    Error: distance to where the point is at that time, so the lag of the servos counts. Forwards and upwards of the
    rest pose the wrist ends at its limit: there the position is kept, the orientation cannot be.
    """
    speed = 0.04
    b = bench(mode, np.array(REST_QPOS))
    begin, rot = b.tip()
    axes = np.zeros((WORLDS, 2, 3))
    for world, (first, second) in enumerate(
        [(0, 1), (1, 2), (0, 2), (0, 1), (0, 2), (1, 2), (0, 1), (0, 2)]
    ):
        axes[world, 0, first], axes[world, 1, second] = (
            1 - 2 * (world >> 1 & 1),
            1 - 2 * (world >> 2 & 1),
        )
    worst = np.zeros(WORLDS)
    before = begin
    for k in range(round(4 * SIDE / speed * 20)):
        want = begin + square(0.05 * (k + 1), speed) @ axes
        actions = np.zeros((WORLDS, b.controller.dim))
        size = b.controller.gripper
        actions[:, :size] = command(b, want, rot, before)[:, :size]
        before = want
        b.step(actions)
        worst = np.maximum(worst, np.linalg.norm(b.tip()[0] - want, axis=1))
    assert worst.max() < 0.005
