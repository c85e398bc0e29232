"""Targets that an environment may be made for: object types, and links by the roles that homes give them."""

from __future__ import annotations

import dataclasses

from mjhab.config.env import EnvConfig
from mjhab.episodes.starts import aims_of, check_target, valid_targets
from mjhab.layout.layout import Layout
from mjhab.scenes.packs import open_pack
from mjhab.scenes.spec import Home, Pack, Roles
from tests.refusals import refused

OPEN = EnvConfig(task="set_table", subtask="open")
DRAWER = "kitchen_counter/drawer3"
FRIDGE = "fridge/top_door"


def layout_of(pack: Pack, *homes: Home, roles: Roles | None = None) -> Layout:
    return Layout(dataclasses.replace(pack, homes=homes, roles=roles or Roles()), ())


def test_links_are_those_that_play_the_roles_in_the_homes() -> None:
    """`Home.roles` replaces those of the pack, which may then have none."""
    pack = open_pack("builtin")
    own = dataclasses.replace(pack.homes[0], roles=pack.roles)
    layout = layout_of(pack, own)
    assert valid_targets(OPEN, layout) == [DRAWER, FRIDGE]
    assert valid_targets(OPEN, layout) == valid_targets(OPEN, Layout(pack, ()))
    navigate = EnvConfig(task="set_table", subtask="navigate")
    assert aims_of(navigate, layout)[-2:] == [DRAWER, FRIDGE]
    check_target(dataclasses.replace(OPEN, target=FRIDGE), layout)


def test_homes_may_have_other_links_for_a_role() -> None:
    pack = open_pack("builtin")
    links = {**pack.roles.links, "kitchen_drawer": "kitchen_counter/drawer1"}
    other = dataclasses.replace(pack.roles, links=links)
    homes = (pack.homes[0], dataclasses.replace(pack.homes[1], roles=other))
    layout = layout_of(pack, *homes, roles=pack.roles)
    assert valid_targets(OPEN, layout) == [DRAWER, "kitchen_counter/drawer1", FRIDGE]


def test_a_role_that_no_home_has_is_named() -> None:
    pack = open_pack("builtin")
    with refused(said="no link plays the role 'kitchen_drawer'"):
        valid_targets(OPEN, layout_of(pack, pack.homes[0]))
