"""Things of a home that stand on its furniture: found by geometry, and left alone by what an episode places."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mjhab.episodes.generator import EpisodeMaker
from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import PlacedReceptacle, placed_receptacles
from mjhab.layout.standing import clear_of, standing_on
from mjhab.scenes.packs import open_pack
from mjhab.scenes.spec import Geom, Pack, Placement, Prop
from mjhab.sim.mujoco.cpu import CpuSimulator
from tests.real_data import real_data

HOME = "builtin_m0_00"
ROSTER = ("005_tomato_soup_can",) * 5
PLATE_HALF = (0.15, 0.1, 0.02)


def surfaces(pack: Pack) -> list[PlacedReceptacle]:
    """The open surfaces of the home that are higher than the floor."""
    home = pack.homes_by_name[HOME]
    places = placed_receptacles(Layout(pack, ()), home)
    return [place for place in places if place.kind == "open" and place.pos[2] > 0.3]


def with_plates(lift: float, half: tuple[float, float, float] = PLATE_HALF) -> Pack:
    """The built-in pack with a fixed plate in the middle of every open surface, ``lift`` [m] above it."""
    pack = open_pack("builtin")
    plate = Prop("plate", (Geom("box", half, (0.0, 0.0, half[2])),))
    placed = tuple(
        Placement("plate", (place.pos[0], place.pos[1], place.pos[2] + lift), place.yaw)
        for place in surfaces(pack)
    )
    home = pack.homes_by_name[HOME]
    laid = dataclasses.replace(home, props=(*home.props, *placed))
    return dataclasses.replace(pack, props={**pack.props, "plate": plate}, homes=(laid,))


@pytest.mark.parametrize(
    ("lift", "stands"),
    [(-0.07, False), (-0.05, True), (0.0, True), (0.11, True), (0.13, False)],
)
def test_a_thing_stands_where_its_lowest_point_is_near_the_surface(
    lift: float, stands: bool
) -> None:
    pack = with_plates(lift)
    found = standing_on(Layout(pack, ()), pack.homes[0])
    place = max(surfaces(open_pack("builtin")), key=lambda place: np.prod(place.half))
    assert (place.id in found) is stands
    if stands:
        (outline,) = found[place.id]
        np.testing.assert_allclose(outline.mean(0), place.pos[:2], atol=1e-9)
        assert not clear_of((outline,), np.array(place.pos), 0.0)
        # The longer side lies along x of the surface.
        assert clear_of((outline,), place.point(0.0, 0.16), 0.05)
        assert not clear_of((outline,), place.point(0.0, 0.16), 0.07)
        assert not clear_of((outline,), place.point(0.16, 0.0), 0.05)


@pytest.mark.parametrize("name", ["builtin", "styles"])
def test_nothing_stands_in_homes_of_ours_so_their_episodes_are_what_they_were(
    name: str,
) -> None:
    pack = open_pack(name)
    layout = Layout(pack, ())
    assert not any(standing_on(layout, home) for home in pack.homes)


def test_nothing_stands_in_staged_homes_of_replica_cad() -> None:
    pack = open_pack(str(real_data("replica_cad")))
    layout = Layout(pack, ())
    assert not any(standing_on(layout, home) for home in pack.homes[::12])


def test_episodes_keep_clear_of_what_stands_in_the_home() -> None:
    """Before, objects were put into the plates, and every draw was rejected after they had settled."""
    pack = with_plates(0.0)
    maker = EpisodeMaker(CpuSimulator(Layout(pack, ROSTER), 1, 1), "tidy_house", "train")
    home = pack.homes[0]
    found = standing_on(maker.layout, home)
    draws = [maker._draw(0, 0, attempt, home) for attempt in range(4)]
    episodes = [episode for episode in draws if episode is not None]
    assert len(episodes) >= 3
    outlines = tuple(outline for each in found.values() for outline in each)
    for episode in episodes:
        radius = maker._placer.radius(0)
        for pose in episode.object_pose:
            assert clear_of(outlines, pose[:3], radius)
        for target in episode.targets:
            assert clear_of(outlines, np.array(target.goal_pos), radius + 0.02)
    # Episodes of versions that did not are not taken out of the cache.
    assert "-clear" in maker._path(0, 0).name


def test_a_home_whose_surfaces_are_covered_has_no_room() -> None:
    pack = with_plates(0.02, (1.5, 1.5, 0.01))
    maker = EpisodeMaker(CpuSimulator(Layout(pack, ROSTER), 1, 1), "tidy_house", "train")
    assert maker._draw(0, 0, 0, pack.homes[0]) is None
