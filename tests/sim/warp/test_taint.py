"""Faults of the GPU simulator are flagged, in the world that has them.

Every trap test fails when its cure in ``sim/warp*.py`` is taken out.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from mjhab.layout.layout import Layout
from mjhab.robots.fetch.model import REST_QPOS
from mjhab.sim.mujoco.cpu import CpuSimulator
from tests.missing import need_warp
from tests.sim.warp.start import (
    BOX,
    WORLDS,
    bits_of,
    check_rows_repeated,
    chosen,
    hold,
    homes_of,
    rows_of,
    starts,
)
from tests.warp_device import TEST_DEVICE

need_warp()


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
    data = shared.engine.data
    qpos = starts(cpu, drop=0.001)
    qpos[:, cpu.addresses.object_q[BOX] + 2] += 0.001
    ctrl = np.stack([hold(cpu, q) for q in qpos])
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    shared.step(ctrl)
    contacts = int(data.nacon.numpy()[0])
    pairs = int(shared.engine.pairs_peak.numpy()[0])
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
    data = shared.engine.data
    qpos = starts(cpu, drop=0.03)
    ctrl = np.stack([hold(cpu, q) for q in qpos])
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    shared.step(ctrl)
    whole = data.naconmax
    pairs = int(shared.engine.pairs_peak.numpy()[0])
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
    sim = warp.WarpSimulator(
        layout, 1, TEST_DEVICE, sizes=warp.BufferSizes(contacts=200, ccd=100, **least)
    )
    sim.reset([0], homes_of(layout, 1), starts(cpu, drop=0.001)[:1])
    sim.step(np.zeros((1, 15)))
    assert "constraint_overflow" in bits_of(sim.taint())[0]


def test_trap_nan_is_found_mended_and_stays_in_its_world(
    shared, cpu: CpuSimulator, layout: Layout
) -> None:
    homes = homes_of(layout)
    qpos = starts(cpu)
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
        ends.append(rows_of(shared, 0) + rows_of(shared, 2))
    check_rows_repeated(*ends)
    assert [("nan" in names) for names in bits_of(shared.taint())] == [False, True, False]
    assert shared.state().body_pos.isfinite().all() and shared.qpos.isfinite().all()


def test_deep_penetration_is_flagged_in_its_world(
    shared, cpu: CpuSimulator, layout: Layout
) -> None:
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
