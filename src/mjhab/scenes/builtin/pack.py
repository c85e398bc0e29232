"""The built-in pack: homes, furniture and objects made by code."""

from __future__ import annotations

from functools import cache

from mjhab.scenes import roles
from mjhab.scenes.builtin.furniture import (
    builtin_articulations,
    builtin_props,
    furniture_meshes,
)
from mjhab.scenes.builtin.homes import builtin_homes
from mjhab.scenes.builtin.objects import builtin_objects, object_meshes
from mjhab.scenes.pack_source import PackSource
from mjhab.scenes.spec import Pack, Roles

ROLES = Roles(
    places={
        roles.OPEN_SURFACE: (
            "chair_01",
            "table_01",
            "table_02",
            "tvstand",
            "sofa",
            "kitchen_counter/counter_left",
            "kitchen_counter/counter_right",
            "kitchen_counter/sink",
        ),
        roles.COUNTER_TOP: (
            "kitchen_counter/counter_left",
            "kitchen_counter/counter_right",
        ),
        roles.SINK: ("kitchen_counter/sink",),
        roles.DINING_TABLE: ("table_01/*",),
        roles.DRAWER: ("kitchen_counter/drawer3",),
        roles.FRIDGE_SHELF: ("fridge/middle_top",),
    },
    links={
        roles.KITCHEN_DRAWER_LINK: "kitchen_counter/drawer3",
        roles.FRIDGE_DOOR_LINK: "fridge/top_door",
    },
    closed_by={"fridge/middle_top": "fridge/top_door"},
)
"""Roles of the built-in furniture, those of the corresponding ReplicaCAD furniture in the Home Assistant Benchmark."""


# One object: maps and compiled models are cached by the identity of a pack.
@cache
def builtin_pack() -> Pack:
    """Return the built-in pack; always the same object."""
    return Pack(
        "builtin",
        builtin_props(),
        builtin_articulations(),
        builtin_homes(),
        builtin_objects(),
        {**furniture_meshes(), **object_meshes()},
        ROLES,
    )


SOURCE = PackSource("builtin", lambda request: builtin_pack())
