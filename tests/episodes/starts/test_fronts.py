"""The floor in front of drawers and doors follows the furniture, not its name."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from mjhab.episodes.starts.fronts import LinkFront, link_front
from mjhab.layout.layout import Layout
from mjhab.scenes.builtin.furniture_kitchen import FRIDGE_FRONT_AREA
from mjhab.scenes.packs import open_pack
from mjhab.scenes.spec import FrontArea, Home

FRIDGE = "fridge/top_door"
DRAWER = "kitchen_counter/drawer3"


def test_an_area_turns_with_its_furniture() -> None:
    for yaw, box in (
        (0.0, (1.933, 2.833, 1.4, 2.6)),
        (math.pi / 2, (0.4, 1.6, 2.933, 3.833)),
    ):
        front = LinkFront((1.0, 2.0), yaw, FRIDGE_FRONT_AREA)
        np.testing.assert_allclose(front.box, box)
    drawer = LinkFront((0.0, 0.0), math.pi, FrontArea(0.3, 1.5, 0.6))
    np.testing.assert_allclose(drawer.box, (-1.5, -0.3, -0.6, 0.6))


def renamed(layout: Layout) -> tuple[Layout, Home]:
    """The homes with a fridge and a counter of other names, and no area of their own."""
    names = {"fridge": "larder", "kitchen_counter": "bench"}
    pack = layout.pack
    furniture = {
        names[name]: dataclasses.replace(piece, name=names[name], front_area=None)
        for name, piece in pack.articulations.items()
    }
    home = pack.homes[0]
    placed = tuple(
        dataclasses.replace(p, template=names[p.template]) for p in home.articulations
    )
    other = dataclasses.replace(home, articulations=placed)
    return Layout(
        dataclasses.replace(pack, homes=(other,), articulations=furniture), ()
    ), other


@pytest.fixture(scope="module")
def layout() -> Layout:
    return Layout(open_pack("builtin"), ())


def test_furniture_of_another_name_is_opened_from_the_same_floor(layout: Layout) -> None:
    home = layout.pack.homes[0]
    other, changed = renamed(layout)
    assert other.doors == {"larder/top_door", "larder/bottom_door"}
    drawer = link_front(layout, home, DRAWER)
    assert link_front(other, changed, "bench/drawer3") == drawer
    published = link_front(layout, home, FRIDGE)
    assert published.area == FRIDGE_FRONT_AREA
    derived = link_front(other, changed, "larder/top_door")
    assert derived.yaw == published.yaw
    # The handle is at the side of the door, and the area is in front of it.
    side = abs(layout.pack.articulations["fridge"].links[0].handle.pos[1])
    shift = np.abs(np.array(derived.box) - published.box)
    assert shift.max() <= side + 0.4 and shift.min() < 0.01
