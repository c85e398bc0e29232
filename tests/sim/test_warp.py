"""The GPU simulator on Warp's CPU device: agreement with C MuJoCo, isolation of worlds, and each trap of the engine.

Every trap test fails when its cure in ``sim/warp*.py`` is taken out.
"""

from __future__ import annotations

import copy
import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import ModuleType, SimpleNamespace
from typing import Any, cast

import mujoco
import numpy as np
import pytest

from mjhab.core.errors import UsageError
from mjhab.scenes.fetch import REST_QPOS
from mjhab.scenes.layout import Layout
from mjhab.scenes.packs import open_pack
from mjhab.scenes.spec import Home
from mjhab.sim.cpu import CpuSimulator
from mjhab.sim.protocol import TAINTS
from mjhab.sim.settle import parked_robot_qpos, settle

if not os.environ.get("CI"):
    # In CI the engine must be there: the tests then fail rather than pass unseen.
    pytest.importorskip("mujoco_warp", reason="the [gpu] extra is not installed")

CAN, BOX = 0, 1
ROSTER = ("005_tomato_soup_can", "004_sugar_box")
WORLDS = 3


@pytest.fixture(scope="module")
def warp() -> ModuleType:
    from mjhab.sim import warp

    return warp


@pytest.fixture(scope="module")
def layout() -> Layout:
    return Layout(open_pack("builtin"), ROSTER)


@pytest.fixture(scope="module")
def cpu(layout: Layout) -> CpuSimulator:
    return CpuSimulator(layout, WORLDS, 1)


@pytest.fixture(scope="module")
def shared(warp: ModuleType, layout: Layout):
    """One simulator for most tests: kernels load once. Every test resets it."""
    return warp.WarpSimulator(layout, WORLDS, "cpu")


def chosen(layout: Layout) -> list[Home]:
    """The home of each world: with other rooms, not only other furniture."""
    homes = layout.pack.homes
    return [homes[0], homes[len(homes) // 2], homes[-1]]


def homes_of(layout: Layout, count: int = WORLDS) -> list[str]:
    return [home.name for home in chosen(layout)[:count]]


def on_table(layout: Layout, world: int) -> np.ndarray:
    """A point (3,) on the first dining table of a world's home."""
    at = next(p for p in chosen(layout)[world].props if p.template == "table_01")
    return np.array([at.pos[0], at.pos[1], layout.pack.props["table_01"].receptacles[0].pos[2]])


def up(height: float) -> np.ndarray:
    return np.array([0.0, 0.0, height])


def put(sim: CpuSimulator, qpos: np.ndarray, slot: int, pos: np.ndarray) -> None:
    start = sim.addresses.object_q[slot]
    qpos[start : start + 3] = pos


def starts(cpu: CpuSimulator, drop: float = 0.0) -> np.ndarray:
    """(W, nq): the robot out of the way, the can on the table of each world's home, ``drop`` [m] above it."""
    rows = []
    for i, home in enumerate(homes_of(cpu.layout)):
        qpos = cpu.model(home).qpos0.copy()
        qpos[cpu.addresses.robot_q] = parked_robot_qpos()
        put(cpu, qpos, CAN, on_table(cpu.layout, i) + up(cpu.layout.objects[CAN].half[2]))
        qpos = settle(cpu.model(home), cpu.addresses, qpos)[0]
        qpos[cpu.addresses.object_q[CAN] + 2] += drop
        rows.append(qpos)
    return np.stack(rows)


def holding(cpu: CpuSimulator, home: str) -> tuple[np.ndarray, np.ndarray]:
    """A state (nq,) with the can held by a robot far outside, and the ctrl (nu,) that holds it."""
    model, a = cpu.model(home), cpu.addresses
    data = mujoco.MjData(model)
    robot = parked_robot_qpos()
    robot[13:15] = 0.0345
    data.qpos[a.robot_q] = robot
    mujoco.mj_kinematics(model, data)
    body = a.robot_body["gripper_link"]
    turn = np.zeros(4)
    mujoco.mju_mulQuat(turn, data.xquat[body], np.array([np.sqrt(0.5), 0, -np.sqrt(0.5), 0]))
    start = a.object_q[CAN]
    data.qpos[start : start + 7] = [*data.xpos[body], *turn]
    ctrl = data.ctrl[:] = hold(cpu, data.qpos, fingers=-0.01)
    mujoco.mj_step(model, data, 150)
    return data.qpos.copy(), ctrl.copy()


def hold(cpu: CpuSimulator, qpos: np.ndarray, fingers: float | None = None) -> np.ndarray:
    """(nu,) commands that keep the robot of a state where it is."""
    model = cpu.model(homes_of(cpu.layout)[0])
    joints = model.actuator_trnid[:, 0]
    ctrl = np.where(model.actuator_biasprm[:, 1] != 0.0, qpos[model.jnt_qposadr[joints]], 0.0)
    if fingers is not None:
        ctrl[-2:] = fingers
    return ctrl


def bits_of(taint: object) -> list[set[str]]:
    return [{name for i, name in enumerate(TAINTS) if int(mask) >> i & 1} for mask in taint]  # type: ignore[attr-defined]


def rows_of(sim, world: int) -> list[bytes]:
    """Everything of one world that a reset of another must keep."""
    engine, state = sim.engine, sim.state()
    arrays = [engine.qpos_t, engine.qvel_t, engine.warmstart_t, engine.ctrl_t, engine.time_t, engine.asleep_t]
    arrays += [state.link_force, state.finger_force, state.touch, state.tcp_vel]
    arrays += [state.body_pos, state.body_mat, state.body_quat, sim.taint()]
    return [array[world].numpy().tobytes() for array in arrays]


# -- agreement with C MuJoCo -----------------------------------------------------------------------------------------


def test_states_agree_with_the_cpu_simulator(shared, cpu: CpuSimulator, layout: Layout) -> None:
    qpos = starts(cpu, drop=0.05)
    rng = np.random.default_rng(0)
    for sim in (shared, cpu):
        sim.reset(range(WORLDS), homes_of(layout), qpos)
    for step in range(12):
        ctrl = np.stack([hold(cpu, q) for q in qpos]) + rng.uniform(-0.2, 0.2, (WORLDS, 15))
        for sim in (shared, cpu):
            sim.step(ctrl)
        if step in (0, 11):
            got, want = shared.state(), cpu.state()
            for field, limit in {
                "robot_q": 1e-4, "robot_qd": 1e-3, "object_pose": 2e-3, "tcp_vel": 1e-3, "link_q": 1e-5,
                "link_qd": 1e-5, "body_pos": 1e-3, "body_quat": 2e-3, "body_mat": 4e-3,
            }.items():  # fmt: skip
                np.testing.assert_allclose(getattr(got, field), getattr(want, field), atol=limit, err_msg=field)
    # What rests sleeps in both.
    assert shared.engine.data.nv_awake.numpy().tolist() == [15] * WORLDS
    assert not shared.taint().any()


def test_forces_of_a_grasp_agree_with_the_cpu_simulator(shared, cpu: CpuSimulator, layout: Layout) -> None:
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
        got, want = shared.state(), cpu.state()
        pinch = np.linalg.norm(want.finger_force[0, :, CAN], axis=-1)
        assert (pinch > 20.0).all()
        np.testing.assert_allclose(got.finger_force, want.finger_force, atol=limit * pinch.max())
        np.testing.assert_allclose(got.link_force, want.link_force, atol=limit * pinch.max())
        np.testing.assert_array_equal(got.touch, want.touch)
        assert got.touch[0, CAN] and not got.touch[0, BOX]


def test_forces_agree_where_the_robot_is_in_the_thick_of_things(shared, cpu: CpuSimulator, layout: Layout) -> None:
    from mjhab.sim.warp_sizes import stress

    homes = homes_of(layout)
    qpos = np.stack(
        [
            stress(layout, home, cpu.model(home.name), cpu.addresses, i).states[0][0]
            for i, home in enumerate(chosen(layout))
        ]
    )
    for sim in (shared, cpu):
        sim.reset(range(WORLDS), homes, qpos)
    got, want = shared.state(), cpu.state()
    assert (want.link_force > 1.0).sum() >= WORLDS
    np.testing.assert_allclose(got.link_force, want.link_force, rtol=0.05, atol=0.02 * want.link_force.max())
    np.testing.assert_array_equal(got.touch, want.touch)


# -- homes -----------------------------------------------------------------------------------------------------------


def test_trap_static_poses_each_world_rests_on_its_own_furniture(shared, cpu: CpuSimulator, layout: Layout) -> None:
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
        assert float(shared.state().object_pose[world, CAN, 2]) == pytest.approx(top, abs=0.003)


def test_a_world_moves_to_another_home(shared, cpu: CpuSimulator, layout: Layout) -> None:
    qpos = starts(cpu)
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    shared.reset([2], [homes_of(layout)[0]], qpos[:1])
    data = shared.engine.data
    for rows in (data.geom_xpos, data.geom_xmat, shared.engine.model.geom_size, shared.engine.model.body_pos):
        np.testing.assert_array_equal(rows.numpy()[2], rows.numpy()[0])
        assert (rows.numpy()[1] != rows.numpy()[0]).any()


def test_every_home_differs_only_in_rows_that_worlds_have_of_their_own(shared, cpu: CpuSimulator, layout: Layout):
    for home in layout.pack.homes[::10]:
        shared.engine.homes.row(home.name, cpu.model(home.name))
    narrow = copy.copy(cpu.model(homes_of(layout)[0]))
    narrow.jnt_range[-5] *= 0.5
    shared.engine.homes.row("narrow", narrow)
    odd = copy.copy(cpu.model(homes_of(layout)[0]))
    odd.geom_friction[3] += 0.1
    with pytest.raises(ValueError, match="geom_friction"):
        shared.engine.homes.row("odd", odd)


# -- isolation -------------------------------------------------------------------------------------------------------


def test_trap_masked_reset_other_worlds_keep_every_bit(shared, cpu: CpuSimulator, layout: Layout) -> None:
    # World 1 holds the can, so that it has forces to lose; world 0 is reset, whose reset would clear all contacts.
    homes, qpos = homes_of(layout), starts(cpu)
    qpos[1], ctrl = holding(cpu, homes[1])
    ends = []
    for resets in (True, False):
        shared.reset(range(WORLDS), homes, qpos)
        for step in range(9):
            if step == 6 and resets:
                before = [rows_of(shared, world) for world in (1, 2)]
                shared.reset([0], [homes[2]], qpos[2:])
                assert [rows_of(shared, world) for world in (1, 2)] == before
                assert float(shared.state().finger_force[1].abs().max()) > 1.0
            shared.step(np.tile(ctrl, (WORLDS, 1)))
        ends.append([rows_of(shared, world) for world in (1, 2)])
    assert ends[0] == ends[1]


def test_a_reset_wakes_nothing_in_other_worlds(shared, cpu: CpuSimulator, layout: Layout) -> None:
    # In world 1 the box, awake, has just come to touch the sleeping can.
    qpos = starts(cpu)
    can = on_table(layout, 1) + up(layout.objects[CAN].half[2])
    put(cpu, qpos[1], BOX, can + np.array([0.056, 0, 0.037]))
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    tree = cpu.model(homes_of(layout)[1]).body_treeid[cpu.addresses.object_body[CAN]]
    shared.engine.asleep_t[1, tree] = int(tree)
    assert any(w == 1 for w in shared.engine.data.contact.worldid.numpy()[: shared.engine.data.nacon.numpy()[0]])
    shared.reset([0], homes_of(layout)[:1], qpos[:1])
    assert int(shared.engine.asleep_t[1, tree]) == int(tree)


def test_a_replay_after_reset_is_bit_equal(shared, cpu: CpuSimulator, layout: Layout) -> None:
    ends = []
    for _ in range(2):
        shared.reset(range(WORLDS), homes_of(layout), starts(cpu, drop=0.02))
        for step in range(4):
            shared.step(np.random.default_rng(step).uniform(-0.4, 0.4, (WORLDS, 15)))
        ends.append(rows_of(shared, 0))
    assert ends[0] == ends[1]


def test_worlds_are_saved_and_restored(shared, cpu: CpuSimulator, layout: Layout) -> None:
    homes, qpos = homes_of(layout), starts(cpu, drop=0.05)
    ctrl = np.stack([hold(cpu, q) for q in qpos])
    shared.reset(range(WORLDS), homes, qpos)
    shared.step(ctrl)
    saved = shared.get_world(1)
    for world in (0, 2):
        shared.set_world(world, homes[1], saved)
        ctrl[world] = ctrl[1]
    for _ in range(2):
        shared.step(ctrl)
    # The restored worlds are awake, in the other something may have fallen asleep.
    assert rows_of(shared, 0) == rows_of(shared, 2)
    np.testing.assert_allclose(shared.qpos[0], shared.qpos[1], atol=1e-6)
    with pytest.raises(UsageError, match="another layout: qpos"):
        shared.set_world(0, homes[1], saved | {"qpos": np.zeros(5)})


# -- sleep -----------------------------------------------------------------------------------------------------------


def test_what_lies_still_starts_asleep_and_what_falls_does_not(shared, cpu: CpuSimulator, layout: Layout) -> None:
    qpos = starts(cpu, drop=0.05)
    qpos[0] = starts(cpu)[0]
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    model = cpu.model(homes_of(layout)[0])
    can, box = (int(model.body_treeid[cpu.addresses.object_body[slot]]) for slot in (CAN, BOX))
    assert (shared.engine.asleep_t[:, box] >= 0).all()
    assert [int(counter) >= 0 for counter in shared.engine.asleep_t[:, can]] == [True, False, False]
    assert shared.engine.data.nv_awake.numpy().tolist() == [15, 21, 21]


def test_trap_a_teleport_wakes_what_it_moves_and_nothing_else(shared, cpu: CpuSimulator, layout: Layout) -> None:
    qpos = starts(cpu)
    ctrl = np.stack([hold(cpu, q) for q in qpos])
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    for _ in range(6):
        shared.step(ctrl)
    model = cpu.model(homes_of(layout)[0])
    can, box = (int(model.body_treeid[cpu.addresses.object_body[slot]]) for slot in (CAN, BOX))
    assert (shared.engine.asleep_t[:, [can, box]] >= 0).all()
    others = [rows_of(shared, world) for world in (0, 2)]
    lifted = shared.qpos[1].numpy().copy()
    rest = lifted[cpu.addresses.object_q[CAN] + 2]
    lifted[cpu.addresses.object_q[CAN] + 2] += 0.1
    shared.write_qpos(1, lifted)
    assert [rows_of(shared, world) for world in (0, 2)] == others
    assert float(shared.state().object_pose[1, CAN, 2]) == pytest.approx(rest + 0.1)
    body = cpu.addresses.object_body[CAN]
    assert float(shared.state().body_pos[1, body, 2]) == pytest.approx(rest + 0.1)
    for _ in range(5):
        shared.step(ctrl)
    assert float(shared.state().object_pose[1, CAN, 2]) == pytest.approx(rest, abs=0.005)
    assert int(shared.engine.asleep_t[1, box]) >= 0


def test_a_teleport_wakes_what_lay_on_what_it_moves(shared, cpu: CpuSimulator, layout: Layout) -> None:
    # The box stands on the can.
    model = cpu.model(homes_of(layout)[1])
    can, box = (int(model.body_treeid[cpu.addresses.object_body[slot]]) for slot in (CAN, BOX))
    qpos = starts(cpu)
    top = layout.objects[CAN].half[2] + layout.objects[BOX].half[2]
    put(cpu, qpos[1], BOX, qpos[1][cpu.addresses.object_q[CAN] :][:3] + up(top))
    qpos[1] = settle(model, cpu.addresses, qpos[1])[0]
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    assert (shared.engine.asleep_t[1, [can, box]] >= 0).all()
    away = qpos[1].copy()
    away[cpu.addresses.object_q[CAN]] += 5.0
    shared.write_qpos(1, away)
    assert (shared.engine.asleep_t[1, [can, box]] < 0).all()
    height = float(shared.state().object_pose[1, BOX, 2])
    for _ in range(2):
        shared.step(np.stack([hold(cpu, q) for q in qpos]))
    assert float(shared.state().object_pose[1, BOX, 2]) < height - 0.02


def test_a_teleport_stops_the_robot(shared, cpu: CpuSimulator, layout: Layout) -> None:
    qpos = starts(cpu)
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    shared.step(np.stack([hold(cpu, q) for q in qpos]) + 0.2)
    assert float(shared.state().robot_qd[0].abs().max()) > 0.01
    shared.write_qpos(0, qpos[0])
    assert float(shared.state().robot_qd[0].abs().max()) == 0.0
    assert float(shared.state().tcp_vel[0].abs().max()) == 0.0


# -- taint -----------------------------------------------------------------------------------------------------------


@contextmanager
def smaller(sim: Any, buffer: str, size: int) -> Iterator[None]:
    """The engine takes a buffer for smaller than it is; what was captured knows its size."""
    data = sim.engine.data
    whole = getattr(data, buffer)
    setattr(data, buffer, size)
    sim.engine.graphs.forget()
    yield
    setattr(data, buffer, whole)
    sim.engine.graphs.forget()


@pytest.mark.parametrize("buffer", ["naconmax", "naccdmax"])
def test_trap_overflow_of_contacts_taints_until_the_reset(
    shared, cpu: CpuSimulator, layout: Layout, buffer: str
) -> None:
    # Can and box have just landed; there are more points of contact than pairs that may touch.
    data, qpos = shared.engine.data, starts(cpu, drop=0.001)
    qpos[:, cpu.addresses.object_q[BOX] + 2] += 0.001
    ctrl = np.stack([hold(cpu, q) for q in qpos])
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    shared.step(ctrl)
    contacts, pairs = int(data.nacon.numpy()[0]), int(shared.engine.pairs_peak.numpy()[0])
    assert pairs < contacts and not shared.taint().any()
    with smaller(shared, buffer, contacts - 1 if buffer == "naconmax" else 1):
        shared.step(ctrl)
    tainted = [names == {"contact_overflow"} for names in bits_of(shared.taint())]
    # A full contact buffer is everybody's loss; in convex collision the engine knows who lost.
    assert all(tainted) if buffer == "naconmax" else any(tainted)
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    shared.step(ctrl)
    assert not shared.taint().any()


def test_trap_overflow_of_pairs_taints_though_the_engine_says_nothing(
    shared, cpu: CpuSimulator, layout: Layout
) -> None:
    # Pairs beyond the limit are dropped; those that are left give few contacts, so nothing else is full.
    data, qpos = shared.engine.data, starts(cpu, drop=0.03)
    ctrl = np.stack([hold(cpu, q) for q in qpos])
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    shared.step(ctrl)
    whole, pairs = data.naconmax, int(shared.engine.pairs_peak.numpy()[0])
    assert 1 < pairs < whole and not shared.taint().any()
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    with smaller(shared, "naconmax", pairs - 1):
        shared.step(ctrl)
    assert not data.overflow.numpy().any()
    assert all(names == {"contact_overflow"} for names in bits_of(shared.taint()))


@pytest.mark.parametrize("least", [{"rows": 20}, {"rows": 200, "awake": 16}])
def test_trap_overflow_of_constraint_rows_or_awake_dofs_taints(
    warp: ModuleType, cpu: CpuSimulator, layout: Layout, least: dict[str, int]
) -> None:
    sim = warp.WarpSimulator(layout, 1, "cpu", sizes=warp.BufferSizes(contacts=200, ccd=100, **least))
    sim.reset([0], homes_of(layout, 1), starts(cpu, drop=0.001)[:1])
    sim.step(np.zeros((1, 15)))
    assert "constraint_overflow" in bits_of(sim.taint())[0]


def test_trap_nan_is_found_mended_and_stays_in_its_world(shared, cpu: CpuSimulator, layout: Layout) -> None:
    homes, qpos = homes_of(layout), starts(cpu)
    ctrl = np.stack([hold(cpu, q) for q in qpos])
    ends = []
    for breaks in (False, True):
        shared.reset(range(WORLDS), homes, qpos)
        if breaks:
            shared.engine.qvel_t[1, 3] = float("nan")
        shared.step(ctrl)
        assert shared.broken().tolist() == [False, breaks, False]
        if breaks:
            # Else it would overlap with everything and fill the buffers of all worlds.
            assert shared.state().body_pos.isfinite().all()
            shared.mend([1], homes[1:2], shared.qpos[1:2])
            assert shared.broken().tolist() == [False] * WORLDS
        shared.step(ctrl)
        ends.append([rows_of(shared, world) for world in (0, 2)])
    assert ends[0] == ends[1]
    assert [("nan" in names) for names in bits_of(shared.taint())] == [False, True, False]
    assert shared.state().body_pos.isfinite().all() and shared.qpos.isfinite().all()


def test_deep_penetration_is_flagged_in_its_world(shared, cpu: CpuSimulator, layout: Layout) -> None:
    qpos = starts(cpu)
    robot = np.array(REST_QPOS)
    robot[:2] = chosen(layout)[1].walls[0].pos[:2]
    qpos[1, cpu.addresses.robot_q] = robot
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    shared.step(np.zeros((WORLDS, 15)))
    assert bits_of(shared.taint())[0] == bits_of(shared.taint())[2] == set()
    assert "penetration" in bits_of(shared.taint())[1]
    shared.add_taint(0, 1)
    assert bits_of(shared.taint())[0] == {"contact_overflow"}
    shared.reset([0, 1], homes_of(layout)[:2], starts(cpu)[:2])
    assert bits_of(shared.taint()) == [set()] * WORLDS


# -- the device ------------------------------------------------------------------------------------------------------


def test_a_step_copies_nothing_to_the_host(
    shared, cpu: CpuSimulator, layout: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch
    import warp as wp

    qpos = starts(cpu)
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    ctrl = torch.as_tensor(np.stack([hold(cpu, q) for q in qpos]), dtype=torch.float32)

    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("copied to the host")

    with monkeypatch.context() as patch:
        for kind, names in ((torch.Tensor, ("cpu", "numpy", "item", "tolist", "__array__")), (wp.array, ("numpy",))):
            for name in names:
                patch.setattr(kind, name, forbidden)
        shared.step(ctrl)
        state = shared.state()
        taint = shared.taint()
    assert not taint.any()
    for view, owner in ((state.object_pose, shared.engine.data.qpos), (state.body_pos, shared.engine.data.xpos)):
        assert owner.ptr <= view.data_ptr() < owner.ptr + owner.capacity


# -- buffers, arguments ----------------------------------------------------------------------------------------------


def test_buffer_sizes_are_measured_once_and_hold_the_stress(
    warp: ModuleType, cpu: CpuSimulator, layout: Layout, monkeypatch: pytest.MonkeyPatch, shared
) -> None:
    from mjhab.sim import warp_sizes

    monkeypatch.setattr(warp_sizes, "measure_demand", None)
    sizes = warp_sizes.buffer_sizes(layout, cpu.model, cpu.addresses, WORLDS, shared.device)
    assert sizes == shared.engine.sizes
    many = warp_sizes.buffer_sizes(layout, cpu.model, cpu.addresses, 100 * WORLDS, shared.device)
    assert sizes.contacts < many.contacts < 100 * sizes.contacts and many.rows == sizes.rows
    home = layout.pack.homes[0]
    run = warp_sizes.stress(layout, home, cpu.model(home.name), cpu.addresses, 70)
    assert run.rows <= sizes.rows and len(run.states) < WORLDS
    qpos = np.stack([*(qpos for qpos, _ in run.states), starts(cpu)[0]])
    shared.reset(range(WORLDS), [home.name] * WORLDS, qpos)
    shared.step(np.zeros((WORLDS, 15)))
    assert not {"contact_overflow", "constraint_overflow", "nan"} & set().union(*bits_of(shared.taint()))


def host_block(size: int, **_: object) -> Any:
    """Memory on the host in place of memory on a GPU."""
    block = np.zeros(size, np.uint8)
    return SimpleNamespace(ptr=block.ctypes.data, block=block)


def nullcontext_of(*_: object) -> AbstractContextManager[None]:
    return nullcontext()


def test_trap_captured_work_takes_the_memory_of_its_first_run(monkeypatch: pytest.MonkeyPatch) -> None:
    # The body of a conditional graph must hold no allocation, and the engine allocates wherever it computes.
    from mjhab.sim import warp_graphs

    monkeypatch.setattr(warp_graphs.wp, "ScopedAllocator", nullcontext_of)
    arena = warp_graphs._Arena(cast(Any, SimpleNamespace(is_cuda=True)))
    monkeypatch.setattr(warp_graphs.wp, "empty", host_block)
    first = [arena.allocate(size) for size in (64, 64, 128)]
    assert len(set(first)) == 3
    for address, size in zip(first, (64, 64, 128), strict=True):
        arena.deallocate(address, size)

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("memory is allocated while work is captured")

    monkeypatch.setattr(warp_graphs.wp, "empty", refuse)
    with arena.closed():
        assert sorted(arena.allocate(size) for size in (128, 64, 64)) == sorted(first)
        # A block that a graph allocates is its own, but the arena would lend it to other graphs.
        with pytest.raises(RuntimeError, match="takes 64 bytes that its first run did not take"):
            arena.allocate(64)


def test_captured_work_needs_no_memory_but_that_of_its_first_run(
    warp: ModuleType, layout: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A GPU would refuse more. Warp's CPU device keeps what it captures until the end of a capture, which CUDA does not:
    # so the work is done where it would be captured.
    from mjhab.sim import warp_graphs

    asked: list[int] = []
    closed = warp_graphs._Arena.closed

    @contextmanager
    def watched(arena: Any) -> Iterator[None]:
        before = len(arena._kept)
        with closed(arena):
            yield
        asked.append(len(arena._kept) - before)

    monkeypatch.setattr(warp_graphs._Arena, "closed", watched)
    monkeypatch.setattr(warp_graphs.wp, "ScopedCapture", lambda device: nullcontext(SimpleNamespace(graph=None)))
    sim = warp.WarpSimulator(layout, 2, "cpu", sizes=warp.BufferSizes(contacts=512, ccd=256, rows=512))
    home = layout.pack.homes[0].name
    qpos = sim.qpos.clone()
    sim.step(sim.engine.ctrl_t.clone())
    sim.mend_broken()
    rows, ctrl, rings = sim.start_rows([home] * 2, qpos.numpy())
    sim.reset_masked(rows.new_tensor([1, 0]).bool(), rows, qpos, ctrl, rings)
    # Refresh, step, mend, renew: under a condition that does not hold, the latter two are captured without a first run.
    assert asked == [0, 0, 0, 0] and len(sim.engine.graphs._arena._kept) > 10


def test_the_broad_phase_is_one_that_can_stand_under_a_condition(
    warp: ModuleType, layout: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    # For large models the engine would take one that sorts with memory of its own.
    import mujoco_warp

    put = mujoco_warp.put_model

    def put_large(*args: Any, **options: Any) -> Any:
        model = put(*args, **options)
        model.opt.broadphase = mujoco_warp.BroadphaseType.SAP_TILE
        return model

    monkeypatch.setattr(mujoco_warp, "put_model", put_large)
    sim = warp.WarpSimulator(layout, 1, "cpu", sizes=warp.BufferSizes(contacts=512, ccd=256, rows=512))
    assert sim.engine.model.opt.broadphase == mujoco_warp.BroadphaseType.NXN


def test_work_is_captured_once_replayed_and_captured_anew_when_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    from mjhab.sim import warp_graphs

    log: list[str] = []

    class Capture:
        def __init__(self, device: object) -> None:
            self.graph = f"graph {len(log)}"

        def __enter__(self) -> Capture:
            log.append("capture")
            return self

        def __exit__(self, *error: object) -> None:
            log.append("end")

    def launch(graph: str, stream: str) -> None:
        log.append(f"{graph} on {stream}")

    torch_works_on = ["stream 0"]
    monkeypatch.setattr(warp_graphs.wp, "ScopedCapture", Capture)
    monkeypatch.setattr(warp_graphs.wp, "capture_launch", launch)
    monkeypatch.setattr(warp_graphs.wp, "Stream", lambda device: "own stream")
    for name in ("ScopedAllocator", "ScopedDevice", "ScopedStream"):
        monkeypatch.setattr(warp_graphs.wp, name, nullcontext_of)
    monkeypatch.setattr(warp_graphs.wp, "synchronize_device", lambda device: log.append("wait"))
    monkeypatch.setattr(warp_graphs, "torch_stream", lambda device: torch_works_on[0])
    graphs = warp_graphs.Graphs(cast(Any, SimpleNamespace(is_cuda=True)))
    for _ in range(3):
        graphs.run("step", lambda: log.append("work"))
    # Capturing is on a stream of its own, so torch and it wait for each other; a launch is where torch works.
    first = ["wait", "work", "capture", "work", "end", "wait"]
    assert log == [*first, "graph 2 on stream 0", "graph 2 on stream 0"]
    torch_works_on[0] = "stream 7"
    graphs.run("step", lambda: log.append("work"))
    assert log[-1] == "graph 2 on stream 7"
    del log[:]
    graphs.forget()
    graphs.run("step", lambda: log.append("work"))
    assert log == first


def test_without_the_engine_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "mjhab.sim.warp", raising=False)
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(UsageError, match=r"needs warp, .*pip install 'mjhab\[gpu\]'"):
        importlib.import_module("mjhab.sim.warp")


def test_too_many_worlds_for_the_memory(warp: ModuleType, layout: Layout, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise RuntimeError("Failed to allocate 123 bytes on device 'cuda:0'")

    monkeypatch.setattr(warp, "Engine", full)
    sizes = warp.BufferSizes(contacts=64, ccd=64, rows=64)
    with pytest.raises(UsageError, match=r"6 worlds do not fit into the memory of cpu; try 3 .*num_envs"):
        warp.WarpSimulator(layout, 6, "cpu", sizes=sizes)


def test_bad_arguments(warp: ModuleType, layout: Layout) -> None:
    with pytest.raises(UsageError, match="at least 1"):
        warp.WarpSimulator(layout, 0, "cpu")
    with pytest.raises(UsageError, match="unknown device 'cpu:3'"):
        warp.WarpSimulator(layout, 1, "cpu:3")
    sizes = warp.BufferSizes(contacts=64, ccd=64, rows=64)
    with pytest.raises(UsageError, match="builtin_m0_00"):
        warp.WarpSimulator(layout, 1, "cpu", sizes=sizes).model("builtin_m0_0")
