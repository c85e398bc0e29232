"""Inverse kinematics and grasps: what comes out is inside the limits and reaches what was asked for."""

from __future__ import annotations

import ctypes
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.core.boxes import nearest_box_distance
from mjhab.core.kernels.box_gaps import least_box_gaps
from mjhab.core.rotations import mat_from_quat, mat_from_rotation_vector, rotation_vector
from mjhab.episodes.grasps.candidates import LyingObject, ObjectShape, grasp_candidates
from mjhab.experts.arm import ik, ik_kernels, motion
from mjhab.experts.arm.clearance import Boxes
from mjhab.experts.arm.frame_kernels import link_frames, tree_of
from mjhab.experts.arm.sphere_gaps import min_gaps
from mjhab.robots.damped_steps import StepBounds, limited_step
from mjhab.robots.fetch import model as fetch
from mjhab.robots.fetch.robot import ROBOT
from tests.refusals import refused

REST = np.array(fetch.REST_QPOS)
CHAIN = ROBOT.chain
DOFS = ik.columns(CHAIN)
CAN = ObjectShape("cylinder", (0.034, 0.034, 0.051))
WIDE_CAN = ObjectShape("cylinder", (0.0512, 0.0512, 0.0701))
BOX = ObjectShape("box", (0.024, 0.047, 0.088))
BALL = ObjectShape("sphere", (0.0377, 0.0375, 0.036))
BOWL = ObjectShape("bowl", (0.0805, 0.0805, 0.0275))


def reachable(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses (count, 3), (count, 3, 3) that some configuration reaches."""
    rng = np.random.default_rng(seed)
    q = np.repeat(REST[None], count, axis=0)
    q[:, DOFS] = CHAIN.clip(REST + rng.normal(0, 0.6, (count, 15)))[:, DOFS]
    return CHAIN.tip_pose(q)


def test_compiled_frames_are_those_of_the_chain():
    q = np.random.default_rng(2).uniform(-2.0, 2.0, (20, 15))
    frames = CHAIN.forward(q)
    pos, rot = link_frames(tree_of(CHAIN), q)
    np.testing.assert_allclose(pos, frames.pos, atol=1e-12)
    np.testing.assert_allclose(rot, frames.rot, atol=1e-12)


def test_kernels_are_compiled_for_one_kind_of_arrays():
    """Whatever is writable, contiguous or of one box: each further kind would cost seconds of compiling."""
    pos, rot = reachable(0, 2)
    assert not ROBOT.rest.flags.writeable
    for rest, turn in ((ROBOT.rest, rot), (REST, np.repeat(rot, 2, axis=2)[..., ::2])):
        goals = ik.TipGoals(pos, turn, DOFS, rest)
        ik.solve(CHAIN, goals, rest[None])
        for base in (None, np.zeros((2, 3))):
            ik.servo(CHAIN, np.broadcast_to(rest, (2, 15)), goals, base_next=base)
        for count in (1, 2):
            boxes = Boxes.of(np.zeros((count, 3)), 0.1)
            motion.spheres(ROBOT).clearance(np.broadcast_to(rest, (2, 15)), boxes)
            nearest_box_distance(pos, boxes)
    for kernel in (ik_kernels.reach, ik_kernels.servo_steps, min_gaps, least_box_gaps):
        assert len(kernel.signatures) == 1, kernel  # type: ignore[attr-defined]
    # Where the others come from the disk, what they call is not compiled at all.
    assert len(ik_kernels._one_step.signatures) <= 1  # type: ignore[attr-defined]


@pytest.mark.parametrize("far", [0.01, 1.0])
def test_a_compiled_step_is_that_of_the_batched_kinematics(far):
    """Small errors and large ones, for which columns run into their limits."""
    pos, rot = reachable(3, 40)
    q = np.repeat(REST[None], 40, axis=0)
    tip, turn = CHAIN.tip_pose(q)
    goal = tip + far * (pos - tip)
    error = np.concatenate(
        [goal - tip, rotation_vector(rot @ turn.swapaxes(1, 2))], axis=1
    )
    low = (CHAIN.lower - q)[:, DOFS]
    high = (CHAIN.upper - q)[:, DOFS]
    bounds = ik.step_limits(CHAIN)[DOFS]
    pull = np.zeros_like(low)
    wanted = limited_step(
        error, CHAIN.jacobian(q)[:, :, DOFS], pull, StepBounds(low, high, bounds)
    )
    found = ik.servo(CHAIN, q, ik.TipGoals(goal, rot, DOFS, REST))
    np.testing.assert_allclose(found[:, DOFS], np.clip(wanted, low, high), atol=1e-9)


@pytest.mark.parametrize("mode", ["pose", "approach", "closing", "position"])
def test_solutions_reach_their_goals_inside_the_limits(mode):
    pos, rot = reachable(0, 30)
    seeds = ik.random_seeds(CHAIN, REST, DOFS, 12, np.random.default_rng(1))
    found = ik.solve(CHAIN, ik.TipGoals(pos, rot, DOFS, REST, mode), seeds)
    q, cost = found.best(ik.travel_steps(CHAIN, REST, found.q, DOFS))
    assert np.isfinite(cost).mean() >= 0.95
    good = np.isfinite(cost)
    tip, turn = CHAIN.tip_pose(q[good])
    assert np.linalg.norm(tip - pos[good], axis=1).max() < 4e-3
    column = {"approach": 0, "closing": 1}.get(mode)
    if column is not None:
        assert np.sum(
            turn[:, :, column] * rot[good][:, :, column], axis=1
        ).min() > np.cos(0.04)
    if mode == "pose":
        assert (
            np.linalg.norm(rotation_vector(rot[good] @ turn.swapaxes(1, 2)), axis=1).max()
            < 0.04
        )
    assert (q >= CHAIN.lower - 1e-9).all() and (q <= CHAIN.upper + 1e-9).all()
    still = np.setdiff1d(np.arange(15), DOFS)
    np.testing.assert_array_equal(
        q[:, still], np.repeat(REST[None, still], len(q), axis=0)
    )


def fill_freed_memory_with_nan() -> None:
    """Arrays that are made empty next will hold NaN, as they may after any other work of the process."""
    libc = ctypes.CDLL(None)
    libc.malloc.restype = ctypes.c_void_p
    pieces = [(libc.malloc(size), size) for size in range(16, 512, 8) for _ in range(50)]
    for place, size in pieces:
        ctypes.memset(place, 0xFF, size)
        libc.free(ctypes.c_void_p(place))


@pytest.mark.parametrize("mode", ["pose", "approach", "closing", "position"])
def test_what_memory_held_before_does_not_count(mode):
    pos, rot = reachable(0, 3)
    seeds = ik.random_seeds(CHAIN, REST, DOFS, 2, np.random.default_rng(1))
    found = ik.solve(CHAIN, ik.TipGoals(pos, rot, DOFS, REST, mode), seeds)
    for _ in range(5):
        fill_freed_memory_with_nan()
        again = ik.solve(CHAIN, ik.TipGoals(pos, rot, DOFS, REST, mode), seeds)
        np.testing.assert_array_equal(again.q, found.q)


def test_the_base_can_help_to_reach_far_goals():
    rot = CHAIN.tip_pose(REST)[1]
    pos = np.array([[2.0, 1.0, 0.8]])
    seeds = REST[None]
    arm_only = ik.solve(CHAIN, ik.TipGoals(pos, rot, DOFS, REST, "approach"), seeds)
    with_base = ik.solve(
        CHAIN,
        ik.TipGoals(pos, rot, ik.columns(CHAIN, base=True), REST, "approach"),
        seeds,
    )
    assert not arm_only.ok.any() and with_base.ok.all()


def test_hopeless_goals_are_not_called_reached():
    found = ik.solve(
        CHAIN,
        ik.TipGoals(np.array([[3.0, 0, 1]]), np.eye(3)[None], DOFS, REST),
        REST[None],
    )
    assert not found.ok.any()
    assert np.isinf(found.best(np.zeros((1, 1)))[1]).all()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_servo_steps_stay_within_speed_and_limits_and_come_nearer(seed):
    rng = np.random.default_rng(seed)
    q = CHAIN.clip(
        REST + np.where(np.isin(np.arange(15), DOFS), rng.normal(0, 0.3, 15), 0)
    )[None]
    pos, rot = CHAIN.tip_pose(q)
    goal = pos + rng.normal(0, 0.02, (1, 3))
    delta = ik.servo(CHAIN, q, ik.TipGoals(goal, rot, DOFS, REST), rest_gain=0.0)
    assert (np.abs(delta) <= ik.step_limits(CHAIN) + 1e-12).all()
    assert (q + delta >= CHAIN.lower - 1e-12).all() and (
        q + delta <= CHAIN.upper + 1e-12
    ).all()
    assert (
        np.linalg.norm(CHAIN.tip_pose(q + delta)[0] - goal)
        <= np.linalg.norm(pos - goal) + 1e-4
    )


def test_servo_follows_a_straight_line_and_holds_still_while_the_base_drives():
    q = REST[None].copy()
    start, turn = CHAIN.tip_pose(q)
    goal = start + np.array([0.10, 0.05, -0.25])
    for _ in range(60):
        pos, rot = CHAIN.tip_pose(q)
        aim, aim_rot = ik.straight_line(pos, goal, rot, turn, 0.02, 0.05)
        q = q + ik.servo(CHAIN, q, ik.TipGoals(aim, aim_rot, DOFS, REST))
        along = (CHAIN.tip_pose(q)[0] - start)[0]
        line = (goal - start)[0] / np.linalg.norm(goal - start)
        assert np.linalg.norm(along - line * (along @ line)) < 5e-3
    np.testing.assert_allclose(CHAIN.tip_pose(q)[0], goal, atol=2e-3)
    for _ in range(12):
        ahead = q[:, :3] + np.array([-0.005, 0.0, 0.004])
        q = q + ik.servo(CHAIN, q, ik.TipGoals(goal, turn, DOFS, REST), base_next=ahead)
        q[:, :3] = ahead
        np.testing.assert_allclose(CHAIN.tip_pose(q)[0], goal, atol=3e-3)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_rotation_vectors_and_matrices_are_inverse(seed):
    vector = np.random.default_rng(seed).uniform(
        -1.8, 1.8, (5, 3)
    )  # shorter than half a turn
    np.testing.assert_allclose(
        rotation_vector(mat_from_rotation_vector(vector)), vector, atol=1e-7
    )


def test_unwinding_takes_whole_turns_of_continuous_joints_only():
    q = REST.copy()
    q[8] += 4 * np.pi
    q[9] += 0.5
    back = ik.unwind(CHAIN, q, REST)
    assert back[8] == pytest.approx(REST[8]) and back[9] == q[9]


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from([CAN, WIDE_CAN, BOX, BALL, BOWL]), st.floats(-3.2, 3.2), st.booleans()
)
def test_grasps_respect_support_opening_and_geometry(shape, yaw, lying):
    quat = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    height = shape.half[2]
    if lying and shape.kind != "bowl":
        quat = np.array(
            [np.cos(yaw / 2), np.cos(yaw / 2), np.sin(yaw / 2), np.sin(yaw / 2)]
        ) * np.sqrt(0.5)
        height = shape.half[1]
    center = np.array([0.3, -0.2, 0.7 + height])
    found = grasp_candidates(LyingObject.of(shape, np.append(center, quat), 0.7))
    assert len(found) >= 6
    assert (np.diff(found.score) <= 1e-12).all()
    assert (found.width < ROBOT.gripper.opening).all() and (
        found.opening > found.width
    ).all()
    tips = found.pos + 0.03 * found.rot[:, :, 0]
    assert (np.minimum(tips, found.pos)[:, 2] >= 0.7).all()
    palm = (center - (found.pos - 0.032 * found.rot[:, :, 0])) @ mat_from_quat(quat)
    outside = (np.abs(palm) > np.array(shape.half) - 1e-6).any(axis=1)
    if shape.kind == "sphere":
        outside = np.linalg.norm(palm, axis=1) > shape.half[0]
    elif shape.kind != "box":
        outside |= np.linalg.norm(palm[:, :2], axis=1) > shape.half[0]
    assert outside.all(), "the hand's front must stay outside the object"
    np.testing.assert_allclose(
        found.pos - found.pre, 0.10 * found.rot[:, :, 0], atol=1e-9
    )


def test_neighbours_and_robot_decide_what_comes_first():
    center = np.array([0.0, 0.0, 0.751])
    quat = np.array([1.0, 0, 0, 0])
    wall = Boxes.of(np.array([[0.08, 0.0, 0.9]]), [0.02, 0.5, 0.3])
    free = grasp_candidates(
        LyingObject.of(CAN, np.append(center, quat), 0.7), robot_xy=np.array([-1.0, 0])
    )
    tight = grasp_candidates(
        LyingObject.of(CAN, np.append(center, quat), 0.7),
        robot_xy=np.array([-1.0, 0]),
        neighbours=wall,
    )
    assert free.rot[0, 0, 0] > 0.3
    assert 0 < len(tight) < len(free) and (tight.clear >= 0).all()


def test_what_cannot_be_grasped_gives_no_candidates_and_unknown_shapes_are_named():
    slab = ObjectShape("box", (0.08, 0.10, 0.036))
    assert (
        len(
            grasp_candidates(
                LyingObject.of(
                    slab,
                    np.append(np.array([0, 0, 0.036]), np.array([1.0, 0, 0, 0])),
                    0.0,
                )
            )
        )
        == 0
    )
    with refused("object shape", "cilinder", expected="cylinder"):
        grasp_candidates(
            LyingObject.of(
                ObjectShape(cast("Any", "cilinder"), (1, 1, 1)),
                np.append(np.zeros(3), np.array([1.0, 0, 0, 0])),
                0.0,
            )
        )
