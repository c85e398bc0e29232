"""Resets and teleports under masks, as environments on the device do them: the same as one by one, and nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from mjhab.layout.layout import Layout
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.settle import settle
from tests.missing import need_warp
from tests.refusals import refused
from tests.warp_device import TEST_DEVICE, check_repeated

need_warp()

WORLDS = 3
NO = torch.zeros(WORLDS, dtype=torch.bool)


@pytest.fixture(scope="module")
def sims() -> Any:
    from mjhab.sim.warp.simulator import WarpSimulator

    layout = Layout(open_pack("builtin"), ("005_tomato_soup_can", "004_sugar_box"))
    return [WarpSimulator(layout, WORLDS, TEST_DEVICE) for _ in range(2)]


@pytest.fixture(scope="module")
def places(sims: Any) -> Any:
    """Names of homes, and a state (3, nq) in them."""
    homes = [home.name for home in sims[0].layout.pack.homes[:WORLDS]]
    return homes, np.stack(
        [start(sims[0], home, world) for world, home in enumerate(homes)]
    )


@pytest.fixture
def both(sims: Any, places: Any) -> Any:
    """Two simulators in the same state, in motion; homes and states to go to."""
    homes, states = places
    for sim in sims:
        sim.reset(range(WORLDS), homes, states)
        for _ in range(2):
            sim.step(sim.engine.ctrl_t.clone())
    return *sims, homes, states


def start(sim: Any, home: str, world: int) -> np.ndarray:
    """The can stands on a table, the box on the floor beside it, the robot is out of the home."""
    table = next(
        p for p in sim.layout.pack.homes[world].props if p.template == "table_01"
    )
    height = sim.layout.pack.props["table_01"].receptacles[0].pos[2]
    qpos = sim.model(home).qpos0.copy()
    for slot, z in enumerate((height, 0.0)):
        first = sim.addresses.object_q[slot]
        at = (
            table.pos[0] + 1.5 * slot,
            table.pos[1],
            z + sim.layout.objects[slot].half[2] + 0.002,
        )
        qpos[first : first + 3] = at
    return settle(sim.model(home), sim.addresses, qpos)[0]


def everything(sim: Any, world: int) -> dict[str, np.ndarray]:
    """What the physics of a world depends on, what is derived of it, and its flags."""
    state = sim.state()
    engine = sim.engine
    more = {
        name: getattr(state, name)[world]
        for name in ("body_pos", "link_force", "finger_force", "touch")
    }
    more |= {"asleep": engine.asleep_t[world], "taint": engine.taint_t[world]}
    more |= {name: values[world] for name, values in engine.homes._worlds.items()}
    return sim.get_world(world) | {
        name: value.numpy().copy() for name, value in more.items()
    }


def same(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> None:
    """Two simulators did the same."""
    for name, value in theirs.items():
        check_repeated(ours[name], value, name)


def test_a_masked_reset_is_a_reset_of_these_worlds(both: Any) -> None:
    sim, plain, homes, states = both
    other = [homes[2], homes[0], homes[1]]
    starts = np.stack([states[2], states[0], states[1]])
    for each in (sim, plain):
        each.add_taint(1, 4)
    kept = [everything(sim, world) for world in (0, 2)]
    rows, ctrl, rings = sim.start_rows(other, starts)
    sim.reset_masked(
        torch.tensor([False, True, False]),
        rows,
        torch.as_tensor(starts).float(),
        ctrl,
        rings,
    )
    plain.reset([1], [other[1]], starts[1:2])
    same(everything(sim, 1), everything(plain, 1))
    for world, before in zip((0, 2), kept, strict=True):
        for name, value in everything(sim, world).items():
            np.testing.assert_array_equal(value, before[name], err_msg=name)
    assert (sim.engine.asleep_t[1] >= 0).any(), "what lies still sleeps"
    for each in (sim, plain):
        each.step(each.engine.ctrl_t.clone())
    for world in range(WORLDS):
        same(everything(sim, world), everything(plain, world))


def test_a_masked_teleport_is_a_teleport(both: Any) -> None:
    sim, plain, _, states = both
    there = sim.qpos.clone()
    there[:, sim.addresses.robot_q[0]] += 0.25
    rows, ctrl, rings = sim.start_rows(
        [home.name for home in sim.layout.pack.homes[:WORLDS]], states
    )
    moved = torch.tensor([True, False, True])
    sim.reset_masked(NO, rows, there, ctrl, rings, moved)
    plain.teleport([0, 2], there[[0, 2]])
    for world in range(WORLDS):
        same(everything(sim, world), everything(plain, world))


def test_nothing_is_computed_where_nothing_is_due(both: Any) -> None:
    sim, _, homes, states = both
    rows, ctrl, rings = sim.start_rows(homes, states)
    poses = sim.state().body_pos
    right = poses.clone()
    poses[0, -1] += 1.0  # any computation would put this right
    for _ in range(3):  # directly, and as captured work
        sim.reset_masked(NO, rows, sim.qpos.clone(), ctrl, rings)
        sim.mend_broken()
        assert not torch.equal(poses, right)
    sim.reset_masked(
        torch.tensor([False, True, False]),
        rows,
        torch.as_tensor(states).float(),
        ctrl,
        rings,
    )
    np.testing.assert_array_equal(poses[0], right[0])


def test_a_world_that_broke_lies_still_where_it_was(both: Any) -> None:
    sim, _, _, _ = both
    where = sim.qpos[1].clone()
    sim.engine.qvel_t[1, 3] = torch.nan
    sim.step(sim.engine.ctrl_t.clone())
    sim.mend_broken()
    assert sim.broken().tolist() == [False, True, False]
    np.testing.assert_allclose(sim.qpos[1], where, atol=0.02)
    for values in everything(sim, 1).values():
        assert np.isfinite(values).all()
    assert sim.engine.overflown() == [], (
        "what a broken world needs says nothing about the buffers"
    )


def test_other_buffer_sizes_are_checked(sims: Any) -> None:
    from mjhab.sim.warp.sizes import changed_sizes

    sizes = sims[0].engine.sizes
    assert (
        changed_sizes(sizes, {"rows": 7}).rows == 7 and changed_sizes(sizes, {}) == sizes
    )
    with refused("buffer", "row", expected="rows"):
        changed_sizes(sizes, {"row": 7})
    with refused("buffer 'rows'", 0.5):
        changed_sizes(sizes, {"rows": 0.5})  # type: ignore[dict-item]
