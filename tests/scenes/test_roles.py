"""Roles of furniture: who plays them, and what is said when nobody does."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from mjhab.core.errors import UsageError
from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import link_to_open, placed_receptacles, with_role
from mjhab.scenes import roles
from mjhab.scenes.builtin.pack import builtin_pack
from mjhab.scenes.pack_folder import load_pack, save_pack
from mjhab.scenes.pack_source import PACK_SOURCES, PackSource, register_pack
from mjhab.scenes.packs import open_pack
from mjhab.scenes.spec import Pack, Roles
from tests.refusals import refused


def pack_with(**changes: object) -> Pack:
    pack = builtin_pack()
    return dataclasses.replace(pack, homes=pack.homes[:2], **changes)  # type: ignore[arg-type]


def test_every_builtin_home_plays_every_role() -> None:
    pack = builtin_pack()
    asked = {*pack.roles.places, *pack.roles.links}
    assert all(roles.roles_in(pack, home) == asked for home in pack.homes)
    roles.check_roles(pack)


def test_receptacles_of_a_role() -> None:
    layout = Layout(pack_with(), ())
    home = layout.pack.homes[0]
    places = placed_receptacles(layout, home)
    by_role = {
        role: [r.id for r in with_role(places, layout.pack.roles, role)]
        for role in layout.pack.roles.places
    }
    assert by_role[roles.FRIDGE_SHELF] == ["fridge/middle_top"]
    assert by_role[roles.DINING_TABLE] == ["table_01_0/top"]
    assert by_role[roles.COUNTER_TOP] == [
        "kitchen_counter/counter_left",
        "kitchen_counter/counter_right",
    ]
    assert "chair_01_0/seat" in by_role[roles.OPEN_SURFACE]
    (shelf,) = with_role(places, layout.pack.roles, roles.FRIDGE_SHELF)
    (drawer,) = with_role(places, layout.pack.roles, roles.DRAWER)
    assert link_to_open(shelf, layout.pack.roles) == "fridge/top_door"
    assert link_to_open(drawer, layout.pack.roles) == "kitchen_counter/drawer3"


def test_a_home_may_state_roles_of_its_own() -> None:
    own = Roles({roles.DINING_TABLE: ("table_02",)})
    pack = pack_with()
    homes = (pack.homes[0], dataclasses.replace(pack.homes[1], roles=own))
    assert roles.roles_in(pack, homes[1]) == {roles.DINING_TABLE}
    layout = Layout(dataclasses.replace(pack, homes=homes), ())
    found = with_role(placed_receptacles(layout, homes[1]), own, roles.DINING_TABLE)
    assert [r.template for r in found] == ["table_02"]


def test_homes_that_lack_a_role_are_named() -> None:
    pack = pack_with()
    bare = dataclasses.replace(pack.homes[1], articulations=())
    with pytest.raises(
        UsageError, match=rf"role 'sink', which these homes .* lack: '{bare.name}'\."
    ):
        roles.require_roles(pack, [pack.homes[0], bare], [roles.SINK], "task 'x'")
    with refused(
        where="task 'x'", said=("'flower_bed',", "roles of the pack: counter_top,")
    ):
        roles.require_roles(pack, pack.homes, ["flower_bed"], "task 'x'")
    with refused(said="no link plays the role 'flap'"):
        roles.link_with_role(pack.roles, "flap")


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        (Roles({"sink": ("fridge/basin",)}), "role 'sink' names 'fridge/basin'"),
        (Roles(links={"fridge_door": "fridge/flap"}), "'fridge/flap', which is no link"),
        (
            Roles(closed_by={"fridge/top": "fridge/flap"}),
            "'fridge/flap', which is no link",
        ),
    ],
)
def test_roles_that_name_nothing_are_refused(
    tmp_path: Path, stated: Roles, message: str
) -> None:
    save_pack(pack_with(), tmp_path)
    body = json.loads((tmp_path / "pack.json").read_text())
    body["roles"] = dataclasses.asdict(stated)
    (tmp_path / "pack.json").write_text(json.dumps(body))
    with refused(said=message):
        load_pack(tmp_path)


def test_roles_survive_a_folder(tmp_path: Path) -> None:
    save_pack(pack_with(), tmp_path)
    assert load_pack(tmp_path).roles == builtin_pack().roles


def test_a_registered_pack_is_opened_by_its_name() -> None:
    pack = pack_with(name="two_homes")
    register_pack(PackSource("two_homes", lambda request: pack))
    try:
        assert open_pack("two_homes") is pack
        with refused("asset pack", "two_homes", expected="registered once"):
            register_pack(PackSource("two_homes", lambda request: pack))
        with refused("asset pack", "two_home", expected="two_homes"):
            open_pack("two_home")
    finally:
        PACK_SOURCES.remove("two_homes")
    with refused("option", "stage_meshes", expected="stage_mesh", where="pack 'odd'"):
        register_pack(
            PackSource("odd", lambda request: pack, options=frozenset({"stage_meshes"}))
        )
