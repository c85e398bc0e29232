"""Grasp candidates fit the gripper and the object, and every object type has one that physics holds."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mjhab.bench.grasp import GRASPS, Grasp, GraspBench, shake_motion
from mjhab.core.boxes import Boxes
from mjhab.core.rotations import quat_from_axis_angle
from mjhab.episodes.grasps.candidates import ObjectShape, Options, grasp_candidates
from mjhab.episodes.grasps.stable import StableGrasps, shape_of
from mjhab.layout.layout import Layout
from mjhab.robots.fetch.model import REST_QPOS, TCP_LINK
from mjhab.robots.fetch.robot import ROBOT
from mjhab.scenes.builtin.objects import SIZES, builtin_objects
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.scratch import Scratch
from tests.tasks.build import config_of

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("name", sorted(SIZES))
def test_candidates_fit_the_gripper_and_stay_off_the_support(name: str):
    kind = builtin_objects()[name]
    pos = np.array([0.4, -0.2, 0.9])
    turn = quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.7))
    floor = pos[2] - kind.half[2]
    grasps = grasp_candidates(shape_of(kind, {}), pos, turn, support_z=floor)
    assert len(grasps) > 0
    gripper = ROBOT.gripper
    assert (grasps.width < gripper.opening).all()
    assert (grasps.opening <= gripper.opening + 1e-9).all()
    assert (np.diff(grasps.score) <= 1e-9).all()
    np.testing.assert_allclose(np.linalg.det(grasps.rot), 1.0, atol=1e-9)
    # Finger tips, the lowest part of a gripper that points down, keep off the support.
    tips = grasps.pos + gripper.finger[0] * grasps.rot[:, :, 0]
    assert (tips[:, 2] > floor).all()
    assert (np.linalg.norm(grasps.pos - pos, axis=1) < np.linalg.norm(kind.half) + 0.05).all()


def test_neighbours_take_candidates_away():
    shape = ObjectShape("cylinder", (0.034, 0.034, 0.05))
    alone = grasp_candidates(shape, np.zeros(3), UPRIGHT, support_z=-0.05)
    walls = Boxes.of([[0.075, 0, 0.0], [-0.075, 0, 0.0]], [0.02, 0.3, 0.05])
    between = grasp_candidates(shape, np.zeros(3), UPRIGHT, support_z=-0.05, neighbours=walls)
    assert 0 < len(between) < len(alone)


def surface(half: tuple[float, float, float]) -> np.ndarray:
    """Points (N, 3) on the sides of an upright box, 4 mm apart."""
    axes = [np.linspace(-h, h, 1 + int(np.ceil(2 * h / 0.004))) for h in half]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[(np.abs(grid[:, :2]) > np.array(half[:2]) - 1e-9).any(axis=1)]


@pytest.mark.parametrize("name", ["003_cracker_box", "008_pudding_box", "010_potted_meat_can"])
def test_corners_of_boxes_fit_between_the_fingers(name: str):
    shape = shape_of(builtin_objects()[name], {})
    gripper = ROBOT.gripper
    plain = grasp_candidates(shape, np.zeros(3), UPRIGHT, support_z=-shape.half[2])
    every = grasp_candidates(
        shape, np.zeros(3), UPRIGHT, support_z=-shape.half[2], options=Options(corners=True)
    )
    corners = every.take(np.abs(every.rot[:, :2, 1]).max(axis=1) < 0.95)
    assert len(corners) == len(every) - len(plain) > 20
    # The lines on which they close lie level, between two sides.
    np.testing.assert_allclose(corners.rot[:, 2, 1], 0.0, atol=1e-9)
    for pos, rot, width in zip(corners.pos, corners.rot, corners.width, strict=True):
        local = (surface(shape.half) - pos) @ rot
        between = local[
            (local[:, 0] < gripper.finger[0]) & (np.abs(local[:, 2]) < gripper.finger[1])
        ]
        # The tips are as deep as they can be with some room, and the palm keeps off.
        assert width - 0.03 < 2 * np.abs(between[:, 1]).max() < width + 1e-6 < gripper.opening
        palm = (local[:, 0] < gripper.palm_x[1]) & (np.abs(local[:, 2]) < gripper.palm_half[1])
        assert not (palm & (np.abs(local[:, 1]) < gripper.palm_half[0])).any()


class CornerBench(GraspBench):
    """A pudding box by its corner in a moving hand."""

    def _grip(self, grasp: Grasp) -> None:
        shape = shape_of(builtin_objects()["008_pudding_box"], {})
        every = grasp_candidates(
            shape, np.zeros(3), UPRIGHT, support_z=-0.1, options=Options(corners=True)
        )
        best = int(np.flatnonzero((np.abs(every.rot[:, 0, 1]) < 0.8) & (every.kind == 2))[0])
        self.data.qpos[self.qpos] = self.rest
        self.data.qpos[self.qpos[13:]] = every.width[best] / 2 + 0.002
        mujoco.mj_kinematics(self.model, self.data)
        hand = self.data.body(TCP_LINK)
        turn = hand.xmat.reshape(3, 3) @ every.rot[best].T
        start = self.model.joint(self.object).qposadr[0]
        self.data.qpos[start : start + 3] = hand.xpos - turn @ every.pos[best]
        mujoco.mju_mat2Quat(self.data.qpos[start + 3 : start + 7], turn.ravel())
        mujoco.mj_forward(self.model, self.data)


def test_a_box_held_by_its_corner_stays_in_a_moving_hand(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(GRASPS, "008_pudding_box", Grasp(width=0.09, depth=0.0))
    bench = CornerBench("008_pudding_box")
    for _ in range(10):
        bench.step(bench.rest, 0.0, 0.0)
    start, _ = bench.pose_in_hand()
    for k in range(60):
        bench.step(*shake_motion(ROBOT, k * 0.05, bench.rest, np.zeros(7)))
    end, _ = bench.pose_in_hand()
    assert (bench.finger_forces()[0] > 20.0).all()
    assert np.linalg.norm(end - start) < 0.02


@pytest.fixture(scope="module")
def held() -> StableGrasps:
    layout = Layout(open_pack("builtin"), tuple(sorted(SIZES)))
    sim = CpuSimulator(layout, 1, 1)
    return StableGrasps(sim, config_of(REST_QPOS), Scratch(sim))


@pytest.mark.parametrize("name", sorted(SIZES))
def test_every_object_type_can_be_held_without_a_policy(held: StableGrasps, name: str):
    grasps = held.grasps(name)
    assert grasps
    for grasp in grasps:
        assert 0.0 <= grasp.fingers <= 0.05
        assert np.linalg.norm(grasp.pose[:3]) < 0.15
