"""Distances to drive, per world: each its own home and goal."""

from __future__ import annotations

import numpy as np
import pytest

from mjhab.envs.parts.nav_distance import NavDistance
from mjhab.layout.layout import Layout
from mjhab.scenes.freespace import free_map
from mjhab.scenes.packs import open_pack
from tests.refusals import refused


def test_every_world_has_its_own_home_and_goal() -> None:
    layout = Layout(open_pack("builtin"), ())
    homes = [layout.pack.homes[k] for k in (0, 70, 90)]
    maps = {home.name: free_map(home, layout.pack) for home in homes}
    asked: list[str] = []

    def given(name: str) -> object:
        asked.append(name)
        return maps[name]

    ways = NavDistance(layout, 4, given)  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    assert (ways.at(rng.uniform(-3, 3, (4, 2))) == 0.0).all(), "nothing has begun"
    goals = [maps[home.name].sample(rng, maps[home.name].navigable()) for home in homes]
    for world, (home, goal) in enumerate(zip(homes, goals, strict=True)):
        ways.begin(world, home.name, goal)
    ways.begin(0, homes[0].name, goals[0])
    assert set(asked) == {home.name for home in homes}
    for _ in range(5):
        xy = rng.uniform(-4, 4, (4, 2))
        wanted = [
            maps[home.name].distance(xy[k], goals[k]) for k, home in enumerate(homes)
        ]
        np.testing.assert_allclose(ways.at(xy), [*wanted, 0.0], atol=1e-5)
    # A world that moves on leaves the others alone.
    before = ways.at(xy)
    ways.begin(1, homes[2].name, goals[2])
    after = ways.at(xy)
    assert after[1] == pytest.approx(
        maps[homes[2].name].distance(xy[1], goals[2]), abs=1e-5
    )
    np.testing.assert_array_equal(np.delete(after, 1), np.delete(before, 1))
    with refused("home", "builtin_m0_99", expected="builtin_m0_19"):
        ways.begin(0, "builtin_m0_99", goals[0])


def test_distances_fall_on_the_way_to_the_goal() -> None:
    layout = Layout(open_pack("builtin"), ())
    home = layout.pack.homes[0]
    free = free_map(home, layout.pack)
    rng = np.random.default_rng(3)
    start, goal = (free.sample(rng, free.navigable()) for _ in range(2))
    field = free.distances_to(goal)
    ways = NavDistance(layout, 1)
    ways.begin(0, home.name, goal)
    at = start
    left = [ways.at(start[None])[0]]
    while left[-1] > 0.1 and len(left) < 500:
        # Step to the neighbouring cell that is nearest to the goal.
        i, j = free.to_cell(at)
        around = field[i - 1 : i + 2, j - 1 : j + 2]
        at = free.to_xy(
            np.array([i - 1, j - 1]) + np.unravel_index(around.argmin(), around.shape)
        )
        left.append(ways.at(at[None])[0])
    assert left[-1] <= 0.1
    assert (np.diff(left[1:]) < 0).all()
