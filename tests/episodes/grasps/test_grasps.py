"""Grasp candidates fit the gripper and the object, and every object type has one that physics holds."""

from __future__ import annotations

import numpy as np
import pytest

from mjhab.core.boxes import Boxes
from mjhab.core.rotations import quat_from_axis_angle
from mjhab.episodes.grasps.candidates import LyingObject, ObjectShape, grasp_candidates
from mjhab.episodes.grasps.pinch import PinchOptions
from mjhab.episodes.grasps.stable import StableGrasps, shape_of
from mjhab.layout.layout import Layout
from mjhab.robots.fetch.model import REST_QPOS
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
    grasps = grasp_candidates(
        LyingObject.of(shape_of(kind, {}), np.append(pos, turn), floor)
    )
    assert len(grasps) > 0
    gripper = ROBOT.gripper
    assert (grasps.width < gripper.opening).all()
    assert (grasps.opening <= gripper.opening + 1e-9).all()
    assert (np.diff(grasps.score) <= 1e-9).all()
    np.testing.assert_allclose(np.linalg.det(grasps.rot), 1.0, atol=1e-9)
    # Finger tips, the lowest part of a gripper that points down, keep off the support.
    tips = grasps.pos + gripper.finger[0] * grasps.rot[:, :, 0]
    assert (tips[:, 2] > floor).all()
    assert (
        np.linalg.norm(grasps.pos - pos, axis=1) < np.linalg.norm(kind.half) + 0.05
    ).all()


def test_neighbours_take_candidates_away():
    shape = ObjectShape("cylinder", (0.034, 0.034, 0.05))
    alone = grasp_candidates(
        LyingObject.of(shape, np.append(np.zeros(3), UPRIGHT), -0.05)
    )
    walls = Boxes.of([[0.075, 0, 0.0], [-0.075, 0, 0.0]], [0.02, 0.3, 0.05])
    between = grasp_candidates(
        LyingObject.of(shape, np.append(np.zeros(3), UPRIGHT), -0.05), neighbours=walls
    )
    assert 0 < len(between) < len(alone)


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


@pytest.mark.parametrize("slant", [0.12, 0.43])
@pytest.mark.parametrize("name", ["003_cracker_box", "010_potted_meat_can"])
def test_a_hand_turned_to_a_box_straddles_its_end(name: str, slant: float):
    half = np.array(builtin_objects()[name].half)
    shape = ObjectShape("box", (half[0], half[1], half[2]))
    pose = np.append([0.4, -0.2, 0.9], UPRIGHT)
    options = PinchOptions(slants=(slant,))
    every = grasp_candidates(LyingObject.of(shape, pose, 0.9 - half[2]), options=options)
    off = np.arccos(np.clip(np.abs(every.rot[:, :, 1]).max(axis=1), 0.0, 1.0))
    found = every.take(np.abs(off - slant) < 1e-6)
    assert len(found) > 0
    # The grasp test allows 30 degrees between the closing line and the sides that the fingers press.
    assert slant < np.radians(30.0)
    hand = ROBOT.gripper
    share = np.linspace(-1.0, 1.0, 21)
    solid = np.stack(np.meshgrid(share, share, share), axis=-1).reshape(-1, 3) * half
    points = np.einsum("gpj,gjk->gpk", pose[:3] + solid - found.pos[:, None], found.rot)
    x, y, z = np.moveaxis(points, 2, 0)
    between = (np.abs(x) < hand.finger[0]) & (np.abs(z) < hand.finger[1])
    assert (np.abs(y[between]) < hand.opening / 2).all()
    assert between.any(axis=1).all()
    # The upper edge of a palm that points down may shove the box a little.
    palm = (np.abs(y) < hand.palm_half[0]) & (np.abs(z) < hand.finger[1])
    assert (x[palm] > hand.palm_x[1]).all()
