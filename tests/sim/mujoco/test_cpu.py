"""The CPU simulator: homes per world, forces by contact sensors, flags, isolation."""

from __future__ import annotations

import os

import mujoco
import numpy as np
import pytest

from mjhab.layout.contact_sensors import (
    FORCE_SENSOR_WIDTH,
    TOUCH_SENSOR_WIDTH,
    pair_force,
)
from mjhab.layout.layout import Layout
from mjhab.render.home_scene import HomeRenderer
from mjhab.robots.fetch.model import FINGER_LINKS, REST_QPOS
from mjhab.robots.fetch.robot import ROBOT
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import parked_robot_qpos
from tests.refusals import refused

ROSTER = ("005_tomato_soup_can", "004_sugar_box")


@pytest.fixture(scope="module")
def layout() -> Layout:
    return Layout(open_pack("builtin"), ROSTER)


def free_place(layout: Layout, home: int, table: str = "table_01") -> np.ndarray:
    at = next(p for p in layout.pack.homes[home].props if p.template == table)
    top = layout.pack.props[table].receptacles[0]
    return np.array([at.pos[0], at.pos[1], top.pos[2]])


def start(sim: CpuSimulator, home: str) -> np.ndarray:
    qpos = sim.model(home).qpos0.copy()
    qpos[sim.addresses.robot_q] = parked_robot_qpos(ROBOT)
    return qpos


def test_all_homes_share_one_layout(layout: Layout):
    sim = CpuSimulator(layout, 1, 1)
    models = [sim.model(h.name) for h in layout.pack.homes]
    for model in models[1:]:
        for size in (
            "nq",
            "nv",
            "nu",
            "nbody",
            "ngeom",
            "nmesh",
            "nsensor",
            "nsensordata",
            "njnt",
        ):
            assert getattr(model, size) == getattr(models[0], size)
        np.testing.assert_array_equal(model.geom_type, models[0].geom_type)
        np.testing.assert_array_equal(model.geom_contype, models[0].geom_contype)
        np.testing.assert_array_equal(model.geom_bodyid, models[0].geom_bodyid)
    assert any((models[0].geom_pos != m.geom_pos).any() for m in models[1:])


def test_each_world_rests_on_the_furniture_of_its_own_home(layout: Layout):
    homes = [h.name for h in layout.pack.homes[:3]]
    sim = CpuSimulator(layout, 3, 2)
    rows = []
    for i, home in enumerate(homes):
        qpos = start(sim, home)
        qpos[sim.addresses.object_q[0] : sim.addresses.object_q[0] + 3] = free_place(
            layout, i
        ) + np.array([0, 0, 0.08])
        rows.append(qpos)
    sim.reset([0, 1, 2], homes, np.stack(rows))
    ctrl = np.zeros((3, sim.batch.ctrl.shape[1]))
    for _ in range(20):
        sim.step(ctrl)
    for i in range(3):
        top = free_place(layout, i)[2]
        half = layout.objects[0].half[2]
        assert sim.state().object_pose[i, 0, 2] == pytest.approx(top + half, abs=0.003)


def test_contact_sensors_match_the_contact_forces_of_the_engine(layout: Layout):
    home = layout.pack.homes[0].name
    sim = CpuSimulator(layout, 1, 1)
    model = sim.model(home)
    a = sim.addresses
    data = mujoco.MjData(model)
    robot = parked_robot_qpos(ROBOT)
    data.qpos[a.robot_q] = robot
    mujoco.mj_kinematics(model, data)
    tcp = data.xpos[a.robot_body["gripper_link"]].copy()
    quat = data.xquat[a.robot_body["gripper_link"]].copy()
    robot[13:15] = 0.0336
    data.qpos[a.robot_q] = robot
    turn = np.zeros(4)
    mujoco.mju_mulQuat(turn, quat, np.array([np.sqrt(0.5), 0, -np.sqrt(0.5), 0]))
    data.qpos[a.object_q[0] : a.object_q[0] + 7] = [*tcp, *turn]
    for i in range(model.nu):
        data.ctrl[i] = (
            data.qpos[model.jnt_qposadr[model.actuator_trnid[i, 0]]] if i > 2 else 0.0
        )
    data.ctrl[-2:] = -0.01
    mujoco.mj_step(model, data, 30)
    # A second object against the outer side of the left finger: the contacts of one finger are told apart.
    finger = data.body(FINGER_LINKS[0])
    across = finger.xmat.reshape(3, 3)[:, 1]
    outside = finger.xpos + 0.03 * across * np.sign(across @ (finger.xpos - tcp))
    data.qpos[a.object_q[1] : a.object_q[1] + 3] = outside
    mujoco.mj_forward(model, data)
    for side, finger in enumerate(FINGER_LINKS):
        for slot in range(2):
            want = np.zeros(3)
            for c in range(data.ncon):
                bodies = model.geom_bodyid[data.contact.geom[c]]
                if set(bodies) == {a.robot_body[finger], a.object_body[slot]}:
                    local = np.zeros(6)
                    mujoco.mj_contactForce(model, data, c, local)
                    # Normals alone: friction is no part of a contact force, as in the original's engine.
                    force = data.contact.frame[c][:3] * local[0]
                    want += force if bodies[1] == a.robot_body[finger] else -force
            force, touching = pair_force(
                _sensor(data, a.hand_force[side], FORCE_SENSOR_WIDTH),
                _sensor(data, a.touch[slot], TOUCH_SENSOR_WIDTH),
            )
            np.testing.assert_allclose(-force, want, atol=1e-6)
            pressed = slot == 0 or side == 0
            assert bool(touching) is pressed
            assert bool(np.linalg.norm(want) > 1.0) is pressed


def _sensor(data: mujoco.MjData, start: int, width: int) -> np.ndarray:
    return data.sensordata[start : start + width]


@pytest.mark.parametrize(
    ("link", "offset", "by_hand"),
    [
        ("gripper_link", (-0.12, 0.0, 0.0), True),
        ("gripper_link", (0.0, 0.0, 0.0), True),
        ("forearm_roll_link", (0.05, 0.0, 0.0), False),
        ("base_link", (0.3, 0.0, 0.15), False),
    ],
)
def test_the_end_effector_is_gripper_link_and_fingers(
    layout: Layout, link: str, offset: tuple, by_hand: bool
):
    home = layout.pack.homes[0].name
    sim = CpuSimulator(layout, 1, 1)
    model = sim.model(home)
    a = sim.addresses
    data = mujoco.MjData(model)
    qpos = model.qpos0.copy()
    qpos[a.robot_q] = parked_robot_qpos(ROBOT)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    place = data.body(link).xpos + data.body(link).xmat.reshape(3, 3) @ offset
    qpos[a.object_q[0] : a.object_q[0] + 3] = place
    sim.reset([0], [home], qpos[None])
    state = sim.state()
    assert state.touch[0].tolist() == [True] + [False] * (state.touch.shape[1] - 1)
    assert state.ee_contact[0].tolist() == [by_hand] + [False] * (
        state.touch.shape[1] - 1
    )
    # The palm alone counts, too.
    between = offset == (0.0, 0.0, 0.0)
    assert bool(np.any(state.finger_force[0, :, 0])) == between
    by_object = np.linalg.norm(state.finger_force[0].sum(axis=1), axis=-1)
    np.testing.assert_allclose(state.finger_net[0], by_object)
    assert bool((state.finger_net[0] > 1.0).any()) == between


def test_fingers_at_a_wall_bear_a_force_that_the_robot_force_leaves_out(layout: Layout):
    home = layout.pack.homes[0].name
    sim = CpuSimulator(layout, 1, 1)
    model = sim.model(home)
    a = sim.addresses
    data = mujoco.MjData(model)
    qpos = model.qpos0.copy()
    # The arm straight ahead.
    qpos[a.robot_q] = 0.0
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    reach = data.body(FINGER_LINKS[0]).xpos[0]
    wall = next(
        geom
        for geom in np.flatnonzero(model.body_weldid[model.geom_bodyid] == 0)
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX
        and model.geom_contype[geom]
        and model.geom_size[geom, 2] > 1.0
    )
    thin = int(np.argmin(model.geom_size[wall, :2]))
    normal = data.geom_xmat[wall].reshape(3, 3)[:2, thin]
    surface = data.geom_xpos[wall, :2] + normal * model.geom_size[wall, thin]
    qpos[a.robot_q[2]] = np.arctan2(-normal[1], -normal[0])
    for gap in np.arange(0.1, -0.05, -0.005):
        qpos[a.robot_q[:2]] = surface + normal * (reach + gap)
        sim.reset([0], [home], qpos[None])
        state = sim.state()
        if state.finger_net.any():
            break
    assert (state.finger_net[0] > 10.0).all()
    assert not state.link_force.any() and not state.finger_force.any()


def test_reset_of_one_world_keeps_the_bytes_of_the_others(layout: Layout):
    homes = [h.name for h in layout.pack.homes[:2]]
    sim = CpuSimulator(layout, 2, 2)
    sim.reset([0, 1], homes, np.stack([start(sim, h) for h in homes]))
    ctrl = np.random.default_rng(0).uniform(-0.3, 0.3, sim.batch.ctrl.shape)
    for _ in range(5):
        sim.step(ctrl)
    before = [
        sim.batch.qpos[0].tobytes(),
        sim.batch.qvel[0].tobytes(),
        sim.batch.sensordata[0].tobytes(),
    ]
    sim.reset([1], [homes[0]], start(sim, homes[0])[None])
    assert [
        sim.batch.qpos[0].tobytes(),
        sim.batch.qvel[0].tobytes(),
        sim.batch.sensordata[0].tobytes(),
    ] == before


def test_replay_after_reset_is_bit_exact(layout: Layout):
    home = layout.pack.homes[0].name
    sim = CpuSimulator(layout, 1, 1)
    qpos = start(sim, home)
    qpos[sim.addresses.robot_q[2]] = 0.4
    runs = []
    for _ in range(2):
        sim.reset([0], [home], qpos[None])
        for k in range(15):
            sim.step(np.random.default_rng(k).uniform(-0.4, 0.4, sim.batch.ctrl.shape))
        runs.append(sim.batch.qpos[0].tobytes())
    assert runs[0] == runs[1]


def test_deep_penetration_is_flagged(layout: Layout):
    home = layout.pack.homes[0]
    sim = CpuSimulator(layout, 1, 1)
    wall = home.walls[0]
    qpos = start(sim, home.name)
    robot = np.array(REST_QPOS)
    robot[:2] = wall.pos[:2]
    qpos[sim.addresses.robot_q] = robot
    sim.reset([0], [home.name], qpos[None])
    sim.step(np.zeros_like(sim.batch.ctrl))
    assert sim.taint()[0] != 0


def test_bad_arguments(layout: Layout):
    with refused("num_worlds", 0, expected="at least 1"):
        CpuSimulator(layout, 0)
    with refused("home", "builtin_m0_0", expected="builtin_m0_00"):
        CpuSimulator(layout, 1, 1).model("builtin_m0_0")


def test_no_more_threads_than_cores_that_this_process_may_use(
    layout: Layout, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0})
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    assert CpuSimulator(layout, 1).num_threads == 1
    assert HomeRenderer(CpuSimulator(layout, 1)).rasterizer.num_threads == 1
