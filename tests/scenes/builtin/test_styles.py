"""The pack of styles: how its homes differ, and that splits share neither plan nor style."""

from __future__ import annotations

import math

import pytest

from mjhab.scenes.builtin.home_plans import PLANS
from mjhab.scenes.builtin.styles import (
    MACROS,
    STYLES,
    drawn_out,
    mirrored,
    plan_of,
    styles_pack,
)
from mjhab.scenes.packs import open_pack
from mjhab.scenes.spec import Home


def style_of(home: Home) -> str:
    return STYLES[home.micro // 10].name


def test_splits_differ_in_plan_and_style() -> None:
    pack = open_pack("styles")
    assert pack is styles_pack() and len(pack.homes) == len(pack.homes_by_name) == 40
    parts = {
        split: [home for home in pack.homes if home.split == split]
        for split in ("train", "val", "test")
    }
    assert {split: len(homes) for split, homes in parts.items()} == {
        "train": 24,
        "val": 8,
        "test": 8,
    }
    for name, of in (
        ("plan", lambda home: MACROS[home.macro].plan),
        ("style", style_of),
    ):
        kinds = [{of(home) for home in homes} for homes in parts.values()]
        assert not (kinds[0] & kinds[1] or kinds[0] & kinds[2] or kinds[1] & kinds[2]), (
            name
        )
    used = {at.template for home in pack.homes for at in home.props}
    assert used <= set(pack.props)
    for home in pack.homes:
        own = {
            t
            for t in (at.template for at in home.props)
            if t.endswith(("_chair", "_sofa"))
        }
        assert own == {f"{style_of(home)}_chair", f"{style_of(home)}_sofa"}


def test_fridges_stand_on_either_side_and_rooms_have_many_sizes() -> None:
    sides = set()
    for macro in range(len(MACROS)):
        counter, fridge = plan_of(macro, 0).kitchen
        yaw = math.radians(counter[3])
        # Along the y axis of the counter, to the left of who stands with the back to the wall.
        away = -math.sin(yaw) * (fridge[1] - counter[1]) + math.cos(yaw) * (
            fridge[2] - counter[2]
        )
        sides.add(away > 0)
    assert sides == {True, False}
    assert len({plan_of(macro, 0).size for macro in range(len(MACROS))}) >= 8


@pytest.mark.parametrize("plan", PLANS)
def test_a_mirror_twice_is_the_plan(plan) -> None:
    twice = mirrored(mirrored(plan))
    for one, other in zip(
        (*plan.loose, *plan.kitchen), (*twice.loose, *twice.kitchen), strict=True
    ):
        assert one == pytest.approx(other)
    wide = drawn_out(plan, 0, 0.5)
    assert wide.size[0] in (plan.size[0], pytest.approx(plan.size[0] + 0.5))
    assert all(room.extent[2] <= wide.size[0] + 1e-9 for room in wide.rooms)


def test_every_home_has_what_tasks_ask_for() -> None:
    pack = styles_pack()
    wanted = [*pack.roles.places]
    for home in pack.homes:
        here = {at.template for at in (*home.props, *home.articulations)}
        for role in wanted:
            templates = {place.partition("/")[0] for place in pack.roles.places[role]}
            assert templates & here, (home.name, role)
