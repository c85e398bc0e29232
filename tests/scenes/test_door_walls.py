"""Walls beside doors: what the versions of a home have in common, and that they are worth training in."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import mjhab
from mjhab.scenes.builtin.pack import builtin_pack
from mjhab.scenes.door_walls import LEAST_SHARE, with_door_walls
from mjhab.scenes.freespace import free_map
from mjhab.scenes.pack_source import PACK_SOURCES, pack_request
from mjhab.scenes.shapes.footprints import FloorPolygon, outline
from mjhab.scenes.shapes.openings import free_travel, solids_near
from mjhab.scenes.spec import Geom, Home, Pack
from mjhab.tasks.thresholds import TaskConfig
from tests.refusals import refused

DOOR = "fridge/top_door"
FULL_RAD = 2.3


def of(*names: str) -> Pack:
    """The built-in pack with these homes alone."""
    pack = builtin_pack()
    return dataclasses.replace(
        pack, homes=tuple(home for home in pack.homes if home.name in names)
    )


@pytest.fixture(scope="module")
def walled() -> Pack:
    """A home of each floor plan of train and one of val, with two versions."""
    return with_door_walls(
        of("builtin_m0_00", "builtin_m1_03", "builtin_m2_05", "builtin_m3_00"), 2
    )


def pairs(pack: Pack) -> list[tuple[Home, Home]]:
    """Homes and their versions."""
    homes = pack.homes_by_name
    return [
        (homes[name.split("_wall")[0]], home)
        for name, home in homes.items()
        if "_wall" in name
    ]


def test_homes_of_train_have_versions_and_the_others_stay_as_they_are(
    walled: Pack,
) -> None:
    assert [home.name for home in walled.homes] == [
        "builtin_m0_00",
        "builtin_m0_00_wall0",
        "builtin_m0_00_wall1",
        "builtin_m1_03",
        "builtin_m1_03_wall0",
        "builtin_m1_03_wall1",
        "builtin_m2_05",
        "builtin_m2_05_wall0",
        "builtin_m2_05_wall1",
        "builtin_m3_00",
    ]
    before = builtin_pack().homes_by_name
    assert all(
        home == before[name]
        for name, home in walled.homes_by_name.items()
        if "_wall" not in name
    )
    for home, version in pairs(walled):
        assert version.walls[:-1] == home.walls and version.split == "train"
        assert version.props == home.props


def test_the_wall_stops_the_door_behind_what_open_asks_for(walled: Pack) -> None:
    asked = TaskConfig.open_fraction_door
    limits = []
    for home, version in pairs(walled):
        limit = dict(version.open_limits)[DOOR]
        assert asked * FULL_RAD < limit < FULL_RAD
        # The wall stops it there, nothing else before.
        assert free_travel(home, walled)[DOOR] == FULL_RAD
        assert limit == pytest.approx(free_travel(version, walled)[DOOR], abs=0.02)
        limits.append(limit)
    assert max(limits) - min(limits) > 0.2
    assert asked < LEAST_SHARE


def test_the_wall_meets_nothing_and_divides_no_room(walled: Pack) -> None:
    for home, version in pairs(walled):
        panel = version.walls[-1]
        points = outline(panel)
        corners = points[points[:, 2] < 0.01][:, :2][[0, 1, 3, 2]]
        area = FloorPolygon("panel", corners, (0.05, 2.0))
        (fridge,) = (at for at in home.articulations if at.template == "fridge")
        assert not any(
            solid.meets(area) for solid in solids_near(home, walled, fridge, closed=True)
        )
        # What a base of 0.6 m loses is what is nearer to the panel than its radius, and no more.
        before, after = free_map(home, walled), free_map(version, walled)
        lost = before.navigable() & ~after.navigable()
        cells = before.to_xy(np.argwhere(lost))
        local = (cells - panel.pos[:2]) @ _axes(panel)
        beyond = np.maximum(np.abs(local) - panel.size[:2], 0.0)
        assert len(cells) and np.linalg.norm(beyond, axis=1).max() < 0.4


def _axes(panel: Geom) -> np.ndarray:
    """(2, 2) columns: its axes in the world."""
    yaw = 2 * np.arctan2(panel.quat[3], panel.quat[0])
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def test_a_version_follows_from_its_name_alone(walled: Pack) -> None:
    alone = with_door_walls(of("builtin_m2_05"), 1)
    assert alone.homes[1] == walled.homes_by_name["builtin_m2_05_wall0"]
    assert with_door_walls(walled, 0) is walled


def test_a_home_without_room_for_the_wall_has_no_version() -> None:
    pack = of("builtin_m0_00")
    (home,) = pack.homes
    (version,) = with_door_walls(pack, 1).homes[1:]
    panel = version.walls[-1]
    # A box where the panel begins to end: all panels, near and far, would run into it.
    block = dataclasses.replace(panel, size=(panel.size[0], 1.0, panel.size[2]))
    full = dataclasses.replace(home, walls=(*home.walls, block))
    assert with_door_walls(dataclasses.replace(pack, homes=(full,)), 3).homes == (full,)


def test_every_pack_takes_the_option_and_records_it() -> None:
    small = of("builtin_m0_00")
    mjhab.register_pack(mjhab.PackSource("mine", lambda request: small))
    try:
        request = pack_request({"place": "mine", "door_walls": 1})
        pack = mjhab.open_pack(request)
        assert len(pack.homes) == 2 and mjhab.open_pack(request) is pack
    finally:
        PACK_SOURCES.remove("mine")
    assert request.as_json() == {"place": "mine", "door_walls": 1}
    assert "door walls: 1" in str(request)
    with refused("door_walls", -1):
        mjhab.PackRequest("builtin", door_walls=-1)
