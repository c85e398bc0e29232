"""Forward kinematics and Jacobians: against the robot's rest pose, closed forms and differences."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.core.boxes import sphere_box_distance
from mjhab.core.rotations import (
    frame_from_axes,
    quat_from_yaw,
    quat_rotate_inv,
    rotation_vector,
)
from mjhab.experts.arm.clearance import Boxes, RobotSpheres
from mjhab.robots.fetch import model as fetch
from mjhab.robots.fetch.robot import ROBOT
from mjhab.robots.kinematics import Chain, ChainRoot
from tests.refusals import refused

REST = np.array(fetch.REST_QPOS)
EXTRA = ("head_tilt_link", "torso_fixed_link", *fetch.FINGER_LINKS)
CHAIN = ROBOT.chain
FULL = ROBOT.chain_with(EXTRA)
SPHERES = RobotSpheres.from_geoms(
    FULL, ROBOT.body.collision, trunk=fetch.TRUNK_LINKS, distal=fetch.DISTAL_LINKS
)


def configurations(seed: int, count: int) -> np.ndarray:
    """Random configurations (count, 15) inside the limits."""
    rng = np.random.default_rng(seed)
    return CHAIN.clip(rng.uniform(-2.0, 2.0, (count, 15)))


def test_rest_pose_puts_the_tcp_where_the_original_has_it():
    pos, rot = CHAIN.tip_pose(REST)
    np.testing.assert_allclose(
        pos[0] - [0, 0, 0.02], [0.5104, -0.0046, 1.2493], atol=1e-3
    )
    np.testing.assert_allclose(rot[0, :, 0], [-0.363, 0.142, -0.921], atol=1e-3)


def test_straight_arm_is_the_sum_of_its_lengths():
    pos, rot = FULL.tip_pose(np.zeros(15))
    x = -0.086875 + 0.119525 + 0.117 + 0.219 + 0.133 + 0.197 + 0.1245 + 0.1385 + 0.16645
    np.testing.assert_allclose(
        pos[0], [x, 0.0, 0.02 + 0.37743 + 0.34858 + 0.06], atol=1e-12
    )
    np.testing.assert_allclose(rot[0], np.eye(3), atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-7, 7), st.integers(0, 1000))
def test_moving_the_base_moves_everything_rigidly(x, y, yaw, seed):
    q = configurations(seed, 1)
    q[:, :3] = 0.0
    moved = q.copy()
    moved[:, :3] = (x, y, yaw)
    before = CHAIN.forward(q).pos[0, 3:]
    after = CHAIN.forward(moved).pos[0, 3:]
    back = quat_rotate_inv(quat_from_yaw(np.array(yaw)), after - (x, y, 0.0))
    np.testing.assert_allclose(back, before, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_jacobian_is_the_derivative_of_the_pose(seed):
    q = configurations(seed, 3)
    step = 1e-6
    jac = FULL.jacobian(q)
    pos, rot = FULL.tip_pose(q)
    for column in range(15):
        ahead = q.copy()
        ahead[:, column] += step
        new_pos, new_rot = FULL.tip_pose(ahead)
        np.testing.assert_allclose((new_pos - pos) / step, jac[:, :3, column], atol=1e-5)
        spin = rotation_vector(new_rot @ rot.swapaxes(1, 2)) / step
        np.testing.assert_allclose(spin, jac[:, 3:, column], atol=1e-5)


def test_batches_equal_single_evaluations():
    q = configurations(3, 5)
    frames = FULL.forward(q)
    for i, row in enumerate(q):
        np.testing.assert_allclose(FULL.forward(row).pos[0], frames.pos[i], atol=1e-12)


def test_unknown_links_and_joints_are_named():
    with refused("link", "griper_link", expected="gripper_link"):
        Chain.from_tree(
            fetch.KINEMATIC_TREE,
            fetch.FETCH_JOINTS,
            tip="griper_link",
            root=ChainRoot("base_link", 0.02),
        )
    with refused("joint", "elbow_joint", expected="elbow_flex_joint"):
        CHAIN.columns_of(("elbow_joint",))
    with refused(where="link 'laser_link'", said="turned against"):
        ROBOT.chain_with(("laser_link",))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_gripper_frames_are_right_handed_rotations(seed):
    a, b = np.random.default_rng(seed).normal(size=(2, 4, 3))
    rot = frame_from_axes(a, b)
    np.testing.assert_allclose(
        rot @ rot.swapaxes(1, 2), np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rot), 1.0, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_distance_to_a_box_is_that_of_its_nearest_point(seed):
    rng = np.random.default_rng(seed)
    half = rng.uniform(0.05, 0.5, 3)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    center = rng.normal(size=3)
    points = rng.normal(size=(20, 3))
    got = sphere_box_distance(points, Boxes.of(center[None], half, turn[None]))[:, 0]
    local = (points - center) @ turn
    outside = np.linalg.norm(local - np.clip(local, -half, half), axis=1)
    depth = np.min(half - np.abs(local), axis=1)
    np.testing.assert_allclose(got, np.where(depth > 0, -depth, outside), atol=1e-9)


def test_clearance_sees_a_wall_come_nearer_and_the_arm_touch_its_trunk():
    near = [
        SPHERES.clearance(REST, Boxes.of(np.array([[x, 0, 1.0]]), [0.05, 1, 1]))[0]
        for x in (1.5, 1.2, 0.9, 0.5)
    ]
    assert near == sorted(near, reverse=True) and near[0] > 0.5 and near[-1] < 0
    assert SPHERES.self_clearance(REST)[0] > 0.03
    folded = REST.copy()
    folded[[7, 9, 11]] = (1.5, 2.2, 1.5)
    assert SPHERES.self_clearance(folded)[0] < 0
