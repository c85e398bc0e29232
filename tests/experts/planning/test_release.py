"""Letting go of an object: what leans tips over as foreseen, and the hand leaves without touching what it put down."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

import mjhab.envs as envs
from mjhab.core.boxes import Boxes
from mjhab.core.rotations import mat_from_rotation_vector, quat_from_mat
from mjhab.episodes.grasps.candidates import ObjectShape
from mjhab.experts.arm import ik, motion
from mjhab.experts.planning import release
from mjhab.experts.planning.workplace import surroundings
from mjhab.robots.fetch.model import REST_QPOS
from mjhab.robots.fetch.robot import ROBOT

SUGAR = ObjectShape("box", (0.0225, 0.0445, 0.0875))
CAN = ObjectShape("cylinder", (0.05, 0.05, 0.07))


def fallen(shape: ObjectShape, rot: np.ndarray) -> np.ndarray:
    """How far (3,) the centre of an object really moves that is let go touching the floor in orientation ``rot``."""
    size = shape.half if shape.kind == "box" else (shape.half[0], shape.half[2], 0.0)
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1], friction=[1.0, 0.005, 0.001]
    )
    body = spec.worldbody.add_body()
    body.add_freejoint()
    kind = (
        mujoco.mjtGeom.mjGEOM_BOX
        if shape.kind == "box"
        else mujoco.mjtGeom.mjGEOM_CYLINDER
    )
    body.add_geom(type=kind, size=size, mass=0.5, friction=[1.0, 0.005, 0.001])
    model = spec.compile()
    data = mujoco.MjData(model)
    low = np.abs(rot[2]) @ np.array(shape.half)
    if shape.kind == "cylinder":
        low = shape.half[0] * np.hypot(rot[2, 0], rot[2, 1]) + shape.half[2] * abs(
            rot[2, 2]
        )
    data.qpos[:] = [0.0, 0.0, low, *quat_from_mat(rot)]
    # Something slows it down, as fingers do.
    model.dof_damping[:] = [0.0, 0.0, 0.0, 0.01, 0.01, 0.01]
    for _ in range(1500):
        mujoco.mj_step(model, data)
    return data.qpos[:3] - [0.0, 0.0, low]


def leaning(tilt: float, about: float, yaw: float = 0.0) -> np.ndarray:
    """Rotation by ``yaw`` about the vertical, then by ``tilt`` about the level direction ``about`` [rad]."""
    axis = tilt * np.array([[np.cos(about), np.sin(about), 0.0]])
    return (
        mat_from_rotation_vector(axis)[0]
        @ mat_from_rotation_vector(np.array([[0.0, 0.0, yaw]]))[0]
    )


@pytest.mark.parametrize(
    ("shape", "tilt", "yaw", "over"),
    [
        (SUGAR, 0.15, 0.0, False),
        (SUGAR, 0.35, 0.0, False),
        (SUGAR, 0.35, np.pi / 2, True),
        (SUGAR, 0.6, 0.0, True),
        (CAN, 0.3, 0.0, False),
        (CAN, 0.3, 1.0, False),
    ],
)
def test_a_leaning_object_tips_to_where_it_is_expected(
    shape: ObjectShape, tilt: float, yaw: float, over: bool
):
    rot = leaning(tilt, about=0.4, yaw=0.4 + yaw)
    expected = release.tipped(shape, rot)
    real = fallen(shape, rot)
    np.testing.assert_allclose(real, expected, atol=0.015)
    # Its top leans this way; it falls over to there, or back.
    toward = np.array([np.sin(0.4), -np.cos(0.4)])
    assert (expected[:2] @ toward > 0.0) == over
    assert (expected[2] < -0.03) == over


def test_what_stands_or_rolls_does_not_tip():
    np.testing.assert_allclose(release.tipped(SUGAR, np.eye(3)), 0.0, atol=1e-9)
    np.testing.assert_array_equal(
        release.tipped(ObjectShape("sphere", (0.04, 0.04, 0.04)), leaning(0.5, 0.0)),
        np.zeros(3),
    )


def test_a_leaning_cylinder_tips_alike_whichever_way_it_is_turned_about_its_axis():
    tips = [
        release.tipped(CAN, leaning(0.8, about=0.3, yaw=yaw)) for yaw in (0.0, 0.7, 2.0)
    ]
    np.testing.assert_allclose(tips[1:], tips[:1] * 2, atol=1e-9)


@pytest.mark.parametrize(
    ("finger", "speed"),
    [
        (0.02, release.AWAY_SPEED_M_S),
        (0.046, release.TIGHT_AWAY_SPEED_M_S),
        (0.05, release.AWAY_SPEED_M_S),
    ],
)
def test_the_hand_leaves_slowly_where_the_fingers_brush_along(
    finger: float, speed: float
):
    view: Any = SimpleNamespace(
        robot=ROBOT, q=np.array([*REST_QPOS[:13], finger, finger])
    )
    assert release.away_speed(view) == speed


def placed() -> tuple[Any, str, np.ndarray, np.ndarray]:
    env = envs.make(
        task="tidy_house",
        subtask="place",
        num_envs=1,
        split="train",
        autoreset="disabled",
        threads=1,
    )
    env.reset(seed=0, options={"episode": [1]})
    view = env.view(0)
    assert view.subtask is not None
    return view, view.subtask.obj, *motion.tcp(view)


def test_fingers_open_as_far_as_there_is_room(monkeypatch: pytest.MonkeyPatch):
    view, obj, pos, rot = placed()
    now = 2.0 * view.q[13:15].mean()
    assert release.let_go_width(view, obj, pos, rot) == pytest.approx(
        now + release.EXTRA_OPENINGS_M[-1]
    )
    # A board beside each finger.
    sides = [pos + side * (now / 2 + 0.045) * rot[:, 1] for side in (-1.0, 1.0)]
    boards = Boxes.of(sides, [[0.1, 0.005, 0.1]] * 2, [rot] * 2)
    monkeypatch.setattr(release, "surroundings", lambda *_: (boards, boards))
    assert (
        now
        < release.let_go_width(view, obj, pos, rot)
        < now + release.EXTRA_OPENINGS_M[-1]
    )


def test_the_hand_draws_back_out_of_reach_of_the_object_and_never_across_the_fingers(
    monkeypatch: pytest.MonkeyPatch,
):
    view, obj, pos, rot = placed()
    near, target = surroundings(view, obj, pos)
    spot = release.drawn_back(view, obj, pos, rot, view.q)
    way = spot - pos
    assert (
        0.0 < np.linalg.norm(way) <= max(release.DRAW_BACK_M) + 1e-9
        and abs(way @ rot[:, 1]) < 1e-9
    )
    found = ik.solve(
        ROBOT.chain,
        ik.TipGoals(spot[None], rot[None], ik.columns(ROBOT.chain, torso=False), view.q),
        view.q[None],
    )
    assert found.ok[0, 0]
    assert (
        motion.spheres(ROBOT).only(ROBOT.hand_links).clearance(found.q[0], target)[0]
        > release.FREE_CLEARANCE_M
    )
    along = np.array(
        [-rot[:, 0], [0.0, 0.0, 1.0], [-np.cos(view.q[2]), -np.sin(view.q[2]), 0.0]]
    )
    along -= (along @ rot[:, 1])[:, None] * rot[:, 1]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    assert (along @ way / np.linalg.norm(way)).max() > 1.0 - 1e-6
    # Something in the way of the palm: another way, or not as far.
    thing = Boxes.of([spot - 0.11 * rot[:, 0]], [[0.01] * 3])
    monkeypatch.setattr(
        release, "surroundings", lambda *_: (Boxes.join([near, thing]), target)
    )
    other = release.drawn_back(view, obj, pos, rot, view.q) - pos
    assert other @ way / np.linalg.norm(way) < np.linalg.norm(way) - 0.015
