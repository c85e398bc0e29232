"""Spawns: noise within its clips, navigable, collision-free, bounded."""

from __future__ import annotations

import numpy as np
import pytest

from mjhab.core.seeding import stream
from mjhab.envs.spawns import ARM_NOISE, MAX_DISTANCE, SpawnGoal, SpawnSampler
from mjhab.scenes.fetch import REST_QPOS
from mjhab.scenes.layout import Layout
from mjhab.scenes.packs import open_pack
from mjhab.sim.cpu import CpuSimulator
from mjhab.sim.settle import parked_robot_qpos
from mjhab.tasks.plan import front_box


@pytest.fixture(scope="module")
def sampler() -> SpawnSampler:
    return SpawnSampler(CpuSimulator(Layout(open_pack("builtin"), ()), 1, 1))


def empty_home(sampler: SpawnSampler, home: str) -> np.ndarray:
    qpos = sampler.sim.model(home).qpos0.copy()
    qpos[sampler.sim.addresses.robot_q] = parked_robot_qpos()
    return qpos


def spawns(sampler: SpawnSampler, home: str, goal: SpawnGoal, wanted: int) -> list[np.ndarray]:
    found: list[np.ndarray] = []
    qpos = empty_home(sampler, home)
    for k in range(400):
        start = sampler.try_once(home, qpos, goal, stream(0, home, k))
        if start is not None:
            found.append(start)
        if len(found) == wanted:
            break
    return found


@pytest.mark.parametrize("home", ["builtin_m0_00", "builtin_m1_00", "builtin_m3_00"])
def test_spawns_near_a_table(sampler: SpawnSampler, home: str):
    spec = next(h for h in sampler.sim.layout.pack.homes if h.name == home)
    table = next(p for p in spec.props if p.template == "table_01")
    goal = SpawnGoal(np.array(table.pos[:2]))
    starts = spawns(sampler, home, goal, 12)
    assert len(starts) == 12
    for start in starts:
        q = start[sampler.sim.addresses.robot_q]
        away = goal.face - q[:2]
        assert np.hypot(*away) <= MAX_DISTANCE
        bearing = np.arctan2(away[1], away[0]) - q[2]
        assert abs((bearing + np.pi) % (2 * np.pi) - np.pi) <= 0.5 + 1e-9
        assert np.abs(q[3:] - REST_QPOS[3:]).max() <= ARM_NOISE[1] + 1e-9
        assert sampler.scratch.collision_free(home, start)
    assert len({s.tobytes() for s in starts}) == 12


def test_spawns_in_front_of_the_fridge(sampler: SpawnSampler):
    home = sampler.sim.layout.pack.homes[0]
    fridge = next(p for p in home.articulations if p.template == "fridge")
    area = np.array(front_box("fridge/top_door", fridge.pos[:2], fridge.yaw))
    for start in spawns(sampler, home.name, SpawnGoal(np.array(fridge.pos[:2]), area), 6):
        x, y = start[sampler.sim.addresses.robot_q[:2]]
        assert area[0] <= x <= area[1] and area[2] <= y <= area[3]


def test_a_robot_in_a_wall_is_not_free(sampler: SpawnSampler):
    home = sampler.sim.layout.pack.homes[0]
    qpos = empty_home(sampler, home.name)
    assert sampler.scratch.collision_free(home.name, qpos)
    qpos[sampler.sim.addresses.robot_q[:2]] = home.walls[0].pos[:2]
    assert not sampler.scratch.collision_free(home.name, qpos)


def test_fallback_is_valid_where_one_exists(sampler: SpawnSampler):
    home = sampler.sim.layout.pack.homes[0]
    table = next(p for p in home.props if p.template == "table_01")
    start = sampler.fallback(home.name, empty_home(sampler, home.name), SpawnGoal(np.array(table.pos[:2])))
    assert sampler.scratch.collision_free(home.name, start)
