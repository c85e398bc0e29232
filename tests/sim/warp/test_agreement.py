"""The GPU simulator on Warp's CPU device agrees with C MuJoCo, in every home.

Every trap test fails when its cure in ``sim/warp*.py`` is taken out.
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest

from mjhab.layout.layout import Layout
from mjhab.sim.mujoco.cpu import CpuSimulator
from tests.missing import need_warp
from tests.sim.warp.start import (
    BOX,
    CAN,
    WORLDS,
    chosen,
    hold,
    holding,
    homes_of,
    on_table,
    starts,
)

need_warp()


def test_states_agree_with_the_cpu_simulator(
    shared, cpu: CpuSimulator, layout: Layout
) -> None:
    qpos = starts(cpu, drop=0.05)
    rng = np.random.default_rng(0)
    for sim in (shared, cpu):
        sim.reset(range(WORLDS), homes_of(layout), qpos)
    for step in range(12):
        ctrl = np.stack([hold(cpu, q) for q in qpos]) + rng.uniform(
            -0.2, 0.2, (WORLDS, 15)
        )
        for sim in (shared, cpu):
            sim.step(ctrl)
        if step in (0, 11):
            got = shared.state()
            want = cpu.state()
            for field, limit in {
                "robot_q": 1e-4,
                "robot_qd": 1e-3,
                "object_pose": 2e-3,
                "tcp_vel": 1e-3,
                "link_q": 1e-5,
                "link_qd": 1e-5,
                "body_pos": 1e-3,
                "body_quat": 2e-3,
                "body_mat": 4e-3,
            }.items():
                np.testing.assert_allclose(
                    getattr(got, field), getattr(want, field), atol=limit, err_msg=field
                )
    # What rests sleeps in both.
    assert shared.engine.data.nv_awake.numpy().tolist() == [15] * WORLDS
    assert not shared.taint().any()


def test_forces_of_a_grasp_agree_with_the_cpu_simulator(
    shared, cpu: CpuSimulator, layout: Layout
) -> None:
    home = homes_of(layout)[0]
    qpos, ctrl = holding(cpu, home)
    for sim in (shared, cpu):
        sim.reset(range(WORLDS), [home] * WORLDS, np.tile(qpos, (WORLDS, 1)))
    # Which points stand for the contact of lid and palm is arbitrary: moved by 9 m, C MuJoCo itself differs by 6 %.
    limit = 0.1
    for steps in (0, 1, 9):
        for sim in (shared, cpu):
            for _ in range(steps):
                sim.step(np.tile(ctrl, (WORLDS, 1)))
        got = shared.state()
        want = cpu.state()
        pinch = np.linalg.norm(want.finger_force[0, :, CAN], axis=-1)
        assert (pinch > 20.0).all()
        np.testing.assert_allclose(
            got.finger_force, want.finger_force, atol=limit * pinch.max()
        )
        np.testing.assert_allclose(
            got.link_force, want.link_force, atol=limit * pinch.max()
        )
        # The can alone is between the fingers: the net force on each is that of the can.
        np.testing.assert_allclose(want.finger_net[0], pinch, rtol=1e-9)
        np.testing.assert_allclose(
            got.finger_net, want.finger_net, atol=limit * pinch.max()
        )
        np.testing.assert_array_equal(got.touch, want.touch)
        np.testing.assert_array_equal(got.ee_contact, want.ee_contact)
        assert got.touch[0, CAN] and not got.touch[0, BOX]


def test_forces_agree_where_the_robot_is_in_the_thick_of_things(
    shared, cpu: CpuSimulator, layout: Layout
) -> None:
    from mjhab.sim.warp.sizes import stress

    homes = homes_of(layout)
    qpos = np.stack(
        [
            stress(layout, home, cpu.model(home.name), cpu.addresses, i).states[0][0]
            for i, home in enumerate(chosen(layout))
        ]
    )
    for sim in (shared, cpu):
        sim.reset(range(WORLDS), homes, qpos)
    got = shared.state()
    want = cpu.state()
    assert (want.link_force > 1.0).sum() >= WORLDS
    np.testing.assert_allclose(
        got.finger_net, want.finger_net, rtol=0.05, atol=0.02 * want.link_force.max()
    )
    np.testing.assert_allclose(
        got.link_force, want.link_force, rtol=0.05, atol=0.02 * want.link_force.max()
    )
    np.testing.assert_array_equal(got.touch, want.touch)
    np.testing.assert_array_equal(got.ee_contact, want.ee_contact)


def test_trap_static_poses_each_world_rests_on_its_own_furniture(
    shared, cpu: CpuSimulator, layout: Layout
) -> None:
    shared.reset(range(WORLDS), homes_of(layout), starts(cpu))
    for world, home in enumerate(homes_of(layout)):
        data = mujoco.MjData(cpu.model(home))
        mujoco.mj_kinematics(cpu.model(home), data)
        static = cpu.model(home).body_weldid[cpu.model(home).geom_bodyid] == 0
        got = shared.engine.data.geom_xpos.numpy()[world]
        np.testing.assert_allclose(got[static], data.geom_xpos[static], atol=1e-5)
    for _ in range(8):
        shared.step(np.stack([hold(cpu, q) for q in starts(cpu)]))
    for world in range(WORLDS):
        top = on_table(layout, world)[2] + layout.objects[CAN].half[2]
        assert float(shared.state().object_pose[world, CAN, 2]) == pytest.approx(
            top, abs=0.003
        )


def test_a_world_moves_to_another_home(shared, cpu: CpuSimulator, layout: Layout) -> None:
    qpos = starts(cpu)
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    shared.reset([2], [homes_of(layout)[0]], qpos[:1])
    data = shared.engine.data
    for rows in (
        data.geom_xpos,
        data.geom_xmat,
        shared.engine.model.geom_size,
        shared.engine.model.body_pos,
    ):
        np.testing.assert_array_equal(rows.numpy()[2], rows.numpy()[0])
        assert (rows.numpy()[1] != rows.numpy()[0]).any()


def test_every_home_differs_only_in_rows_that_worlds_have_of_their_own(
    shared, cpu: CpuSimulator, layout: Layout
):
    for home in layout.pack.homes[::10]:
        shared.engine.homes.row(home.name, cpu.model(home.name))
    narrow = copy.copy(cpu.model(homes_of(layout)[0]))
    narrow.jnt_range[-5] *= 0.5
    shared.engine.homes.row("narrow", narrow)
    odd = copy.copy(cpu.model(homes_of(layout)[0]))
    odd.geom_friction[3] += 0.1
    with pytest.raises(ValueError, match="geom_friction"):
        shared.engine.homes.row("odd", odd)
