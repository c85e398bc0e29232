"""What happens to one world of the GPU simulator is nothing to the others: resets, teleports, sleep.

Every trap test fails when its cure in ``sim/warp*.py`` is taken out.
"""

from __future__ import annotations

import numpy as np
import pytest

from mjhab.layout.layout import Layout
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import settle
from tests.missing import need_warp
from tests.refusals import refused
from tests.sim.warp.start import (
    BOX,
    CAN,
    WORLDS,
    bits,
    check_rows_repeated,
    hold,
    holding,
    homes_of,
    on_table,
    put,
    rows_of,
    starts,
    up,
)

need_warp()


def test_trap_masked_reset_other_worlds_keep_every_bit(
    shared, cpu: CpuSimulator, layout: Layout
) -> None:
    # World 1 holds the can, so that it has forces to lose; world 0 is reset, whose reset would clear all contacts.
    homes = homes_of(layout)
    qpos = starts(cpu)
    qpos[1], ctrl = holding(cpu, homes[1])
    ends = []
    for resets in (True, False):
        shared.reset(range(WORLDS), homes, qpos)
        for step in range(9):
            if step == 6 and resets:
                before = [bits(rows_of(shared, world)) for world in (1, 2)]
                shared.reset([0], [homes[2]], qpos[2:])
                assert [bits(rows_of(shared, world)) for world in (1, 2)] == before
                assert float(shared.state().finger_force[1].abs().max()) > 1.0
            shared.step(np.tile(ctrl, (WORLDS, 1)))
        ends.append(rows_of(shared, 1) + rows_of(shared, 2))
    check_rows_repeated(*ends)


def test_a_reset_wakes_nothing_in_other_worlds(
    shared, cpu: CpuSimulator, layout: Layout
) -> None:
    # In world 1 the box, awake, has just come to touch the sleeping can.
    qpos = starts(cpu)
    can = on_table(layout, 1) + up(layout.objects[CAN].half[2])
    put(cpu, qpos[1], BOX, can + np.array([0.056, 0, 0.037]))
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    tree = cpu.model(homes_of(layout)[1]).body_treeid[cpu.addresses.object_body[CAN]]
    shared.engine.asleep_t[1, tree] = int(tree)
    assert any(
        w == 1
        for w in shared.engine.data.contact.worldid.numpy()[
            : shared.engine.data.nacon.numpy()[0]
        ]
    )
    shared.reset([0], homes_of(layout)[:1], qpos[:1])
    assert int(shared.engine.asleep_t[1, tree]) == int(tree)


def test_a_replay_after_reset_is_equal(shared, cpu: CpuSimulator, layout: Layout) -> None:
    ends = []
    for _ in range(2):
        shared.reset(range(WORLDS), homes_of(layout), starts(cpu, drop=0.02))
        for step in range(4):
            shared.step(np.random.default_rng(step).uniform(-0.4, 0.4, (WORLDS, 15)))
        ends.append(rows_of(shared, 0))
    check_rows_repeated(*ends)


def test_worlds_are_saved_and_restored(shared, cpu: CpuSimulator, layout: Layout) -> None:
    homes = homes_of(layout)
    qpos = starts(cpu, drop=0.05)
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
    check_rows_repeated(rows_of(shared, 0), rows_of(shared, 2))
    np.testing.assert_allclose(shared.qpos[0], shared.qpos[1], atol=1e-6)
    with refused("qpos of the state", (5,)):
        shared.set_world(0, homes[1], saved | {"qpos": np.zeros(5)})


def test_what_lies_still_starts_asleep_and_what_falls_does_not(
    shared, cpu: CpuSimulator, layout: Layout
) -> None:
    qpos = starts(cpu, drop=0.05)
    qpos[0] = starts(cpu)[0]
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    model = cpu.model(homes_of(layout)[0])
    can, box = (
        int(model.body_treeid[cpu.addresses.object_body[slot]]) for slot in (CAN, BOX)
    )
    assert (shared.engine.asleep_t[:, box] >= 0).all()
    assert [int(counter) >= 0 for counter in shared.engine.asleep_t[:, can]] == [
        True,
        False,
        False,
    ]
    assert shared.engine.data.nv_awake.numpy().tolist() == [15, 21, 21]


def test_trap_a_teleport_wakes_what_it_moves_and_nothing_else(
    shared, cpu: CpuSimulator, layout: Layout
) -> None:
    qpos = starts(cpu)
    ctrl = np.stack([hold(cpu, q) for q in qpos])
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    for _ in range(6):
        shared.step(ctrl)
    model = cpu.model(homes_of(layout)[0])
    can, box = (
        int(model.body_treeid[cpu.addresses.object_body[slot]]) for slot in (CAN, BOX)
    )
    assert (shared.engine.asleep_t[:, [can, box]] >= 0).all()
    others = [bits(rows_of(shared, world)) for world in (0, 2)]
    lifted = shared.qpos[1].numpy().copy()
    rest = lifted[cpu.addresses.object_q[CAN] + 2]
    lifted[cpu.addresses.object_q[CAN] + 2] += 0.1
    shared.write_qpos(1, lifted)
    assert [bits(rows_of(shared, world)) for world in (0, 2)] == others
    assert float(shared.state().object_pose[1, CAN, 2]) == pytest.approx(rest + 0.1)
    body = cpu.addresses.object_body[CAN]
    assert float(shared.state().body_pos[1, body, 2]) == pytest.approx(rest + 0.1)
    for _ in range(5):
        shared.step(ctrl)
    assert float(shared.state().object_pose[1, CAN, 2]) == pytest.approx(rest, abs=0.005)
    assert int(shared.engine.asleep_t[1, box]) >= 0


def test_a_teleport_wakes_what_lay_on_what_it_moves(
    shared, cpu: CpuSimulator, layout: Layout
) -> None:
    # The box stands on the can.
    model = cpu.model(homes_of(layout)[1])
    can, box = (
        int(model.body_treeid[cpu.addresses.object_body[slot]]) for slot in (CAN, BOX)
    )
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
