"""The pack "styles": 40 more homes for generalisation beyond the paper's split.

Its splits differ in floor plan *and* in furniture style: no plan and no style of val or test is in train. The plans are
those of the built-in homes, mirrored along x (so that the fridge is on the other side of the counter) or not, and
enlarged along one axis or both. A style has its own materials of walls, floors and coverings, and its own names of
templates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np

from mjhab.core.seeding import stream
from mjhab.scenes.builtin.furniture import (
    builtin_articulations,
    builtin_props,
    furniture_meshes,
)
from mjhab.scenes.builtin.home_cache import cached_homes
from mjhab.scenes.builtin.home_plans import PLANS, Piece, Plan, Room, Spot, Wall
from mjhab.scenes.builtin.homes import KEEP_CLEAR_M, Floor, bare_floor, furnish
from mjhab.scenes.builtin.objects import builtin_objects, object_meshes
from mjhab.scenes.builtin.pack import ROLES
from mjhab.scenes.pack_source import PackSource
from mjhab.scenes.shapes.footprints import footprint
from mjhab.scenes.spec import Articulation, Home, Pack, Placement, Prop, Roles

NAME = "styles"
Split = Literal["train", "val", "test"]
Key = tuple[int, int]

RESTYLED: dict[str, str] = {
    "chair_01": "chair",
    "table_01": "dining_table",
    "table_02": "coffee_table",
    "tvstand": "tv_stand",
    "sofa": "sofa",
}
"""Templates that tasks use, of which every style has one of its own, named "<style>_<name>"."""


@dataclass(frozen=True)
class FurnitureStyle:
    """Materials of a style. ``walls``: of outer and inner walls; ``floors``, ``coverings``: replacements by the name of
    the built-in homes' material."""

    name: str
    walls: tuple[str, str]
    floors: dict[str, str]
    coverings: dict[str, str]


STYLES: tuple[FurnitureStyle, ...] = (
    FurnitureStyle(
        "nordic",
        ("wall_white", "wall_sage"),
        {
            "floor_tile": "floor_ash",
            "floor_oak": "floor_ash",
            "floor_slate": "floor_tile",
        },
        {"oak": "birch", "walnut": "birch", "sofa_fabric": "cushion_cream"},
    ),
    FurnitureStyle(
        "classic",
        ("wall_sand", "wall_white"),
        {
            "floor_oak": "floor_walnut",
            "floor_ash": "floor_walnut",
            "floor_carpet": "rug_red",
        },
        {"oak": "walnut", "birch": "walnut", "sofa_fabric": "beanbag_fabric"},
    ),
    FurnitureStyle(
        "loft",
        ("wall_blue", "wall_blue"),
        {
            "floor_tile": "floor_slate",
            "floor_oak": "floor_slate",
            "floor_walnut": "floor_slate",
        },
        {"oak": "black_metal", "birch": "walnut", "sofa_fabric": "mat_grey"},
    ),
    FurnitureStyle(
        "lacquer",
        ("wall_rose", "wall_sand"),
        {
            "floor_oak": "floor_tile",
            "floor_ash": "floor_tile",
            "floor_walnut": "floor_oak",
        },
        {
            "oak": "white_lacquer",
            "walnut": "white_lacquer",
            "sofa_fabric": "cushion_coral",
        },
    ),
)
_DRAWN_OUT_M = ((0.0, 0.0), (0.9, 0.0), (0.0, 0.8), (0.7, 0.6), (1.2, 0.0))


@dataclass(frozen=True)
class Macro:
    """A floor plan made from a built-in one: ``mirrored`` along x, then enlarged by ``by`` (x, y) [m]."""

    plan: int
    mirrored: bool
    by: tuple[float, float]


MACROS: tuple[Macro, ...] = tuple(
    Macro(
        k % len(PLANS),
        mirrored=k < len(PLANS),
        by=_DRAWN_OUT_M[(k + k // len(PLANS)) % 5],
    )
    for k in range(2 * len(PLANS))
)
"""Macro layouts 0 to 4 are the built-in plans mirrored, 5 to 9 the same not mirrored; enlargements differ."""
PLACES_OF_SPLIT: dict[Split, tuple[tuple[int, ...], tuple[int, ...], int]] = {
    "train": ((0, 1, 2, 5, 6, 7), (0, 1), 2),
    "val": ((3, 8), (2,), 4),
    "test": ((4, 9), (3,), 4),
}
"""Macro layouts, styles, and number of homes of every pair of these, by split."""


def _entries() -> tuple[tuple[Split, int, int, int], ...]:
    """(split, macro, style, number among the homes with this macro and style) of every home."""
    return tuple(
        (split, macro, style, number)
        for split, (macros, styles, count) in PLACES_OF_SPLIT.items()
        for macro in macros
        for style in styles
        for number in range(count)
    )


ENTRIES = _entries()
KEYS: tuple[Key, ...] = tuple(
    (macro, style * 10 + number) for _, macro, style, number in ENTRIES
)
"""(macro, micro) of every home; micro is 10 times the style plus the number."""


def mirrored(plan: Plan) -> Plan:
    """Mirror a plan along x: x becomes width - x, and yaw becomes 180 deg - yaw."""
    width = plan.size[0]

    def spot(at: Spot) -> Spot:
        return width - at[0], at[1], 180.0 - at[2]

    def piece(at: Piece) -> Piece:
        return (at[0], *spot(at[1:]))

    def wall(each: Wall) -> Wall:
        if each.axis == "y":
            return replace(each, at=width - each.at)
        # Mirroring turns the order round, and gaps are in ascending order.
        gaps = tuple((width - end, width - start) for start, end in reversed(each.gaps))
        return replace(each, start=width - each.end, end=width - each.start, gaps=gaps)

    def room(each: Room) -> Room:
        x_min, y_min, x_max, y_max = each.extent
        return replace(each, extent=(width - x_max, y_min, width - x_min, y_max))

    return replace(
        plan,
        walls=tuple(map(wall, plan.walls)),
        rooms=tuple(map(room, plan.rooms)),
        kitchen=(piece(plan.kitchen[0]), piece(plan.kitchen[1])),
        fixed=tuple(map(piece, plan.fixed)),
        loose=tuple(map(piece, plan.loose)),
        spots=tuple(map(spot, plan.spots)),
    )


def drawn_out(plan: Plan, axis: int, by: float) -> Plan:
    """Insert ``by`` [m] of floor along an axis (0: x, 1: y) in the middle of the largest free interval of a plan.

    The plan is returned unchanged if furniture, walls and doorways leave no interval free.
    """
    cut = _cut(plan, axis)
    if not by or cut is None:
        return plan

    def moved(value: float) -> float:
        # Nothing lies at the cut itself: it goes through free floor.
        return value + by if value > cut else value

    def spot(at: Spot) -> Spot:
        return (moved(at[0]), at[1], at[2]) if axis == 0 else (at[0], moved(at[1]), at[2])

    def piece(at: Piece) -> Piece:
        return (at[0], *spot(at[1:]))

    def wall(each: Wall) -> Wall:
        if (each.axis == "x") == (axis == 1):
            return replace(each, at=moved(each.at))
        gaps = tuple((moved(start), moved(end)) for start, end in each.gaps)
        return replace(each, start=moved(each.start), end=moved(each.end), gaps=gaps)

    def room(each: Room) -> Room:
        low = list(each.extent)
        low[axis] = moved(low[axis])
        low[axis + 2] = moved(low[axis + 2])
        return replace(each, extent=(low[0], low[1], low[2], low[3]))

    size = (
        (moved(plan.size[0]), plan.size[1])
        if axis == 0
        else (plan.size[0], moved(plan.size[1]))
    )
    return replace(
        plan,
        size=size,
        walls=tuple(map(wall, plan.walls)),
        rooms=tuple(map(room, plan.rooms)),
        kitchen=(piece(plan.kitchen[0]), piece(plan.kitchen[1])),
        fixed=tuple(map(piece, plan.fixed)),
        loose=tuple(map(piece, plan.loose)),
        spots=tuple(map(spot, plan.spots)),
    )


def _cut(plan: Plan, axis: int) -> float | None:
    """Middle of the largest interval along an axis that nothing covers [m]; None if there is none."""
    edge = 0.15  # [m], furniture this near to a wall stays at the wall
    taken = [(0.0, edge), (plan.size[axis] - edge, plan.size[axis])]
    for each in (*plan.kitchen, *plan.fixed, *plan.loose):
        area = footprint(_place(each), _template(each[0]))
        if area is not None:
            taken.append((area.box[axis] - edge, area.box[axis + 2] + edge))
    for wall in plan.walls:
        if (wall.axis == "y") == (axis == 0):
            taken.append((wall.at - edge, wall.at + edge))
        else:
            # A doorway must keep its width.
            taken += wall.gaps
    end = 0.0
    best = (0.0, 0.0)
    # In order of their beginning: the free intervals are between the ends seen so far and the next beginning.
    for low, high in sorted(taken):
        best = max(best, (low - end, (low + end) / 2))
        end = max(end, high)
    return best[1] if best[0] > 0.02 else None


def _place(piece: Piece) -> Placement:
    return Placement(piece[0], (piece[1], piece[2], 0.0), math.radians(piece[3]))


@cache
def _templates() -> dict[str, Prop]:
    return builtin_props()


def _template(name: str) -> Prop | Articulation:
    return _templates().get(name) or builtin_articulations()[name]


@cache
def plan_of(macro: int, style: int) -> Plan:
    """Return the floor plan of a macro layout with the wall and floor materials of a style."""
    chosen = MACROS[macro]
    looks = STYLES[style]
    plan = PLANS[chosen.plan]
    plan = mirrored(plan) if chosen.mirrored else plan
    plan = drawn_out(drawn_out(plan, 0, chosen.by[0]), 1, chosen.by[1])
    rooms = tuple(
        replace(room, floor=looks.floors.get(room.floor, room.floor))
        for room in plan.rooms
    )
    return replace(
        plan, outer_wall=looks.walls[0], inner_wall=looks.walls[1], rooms=rooms
    )


def _floor(macro: int, micro: int) -> Floor:
    style = micro // 10
    split: Split = next(s for s, m, k, n in ENTRIES if (m, k * 10 + n) == (macro, micro))
    name = f"{NAME}_m{macro}_{STYLES[style].name}_{micro % 10}"
    return Floor(name, NAME, split, macro, micro, plan_of(macro, style))


def bare_home(macro: int, micro: int) -> Home:
    """Make a home with walls, kitchen and lamps, but without props."""
    return bare_floor(_floor(macro, micro))


@cache
def make_home(macro: int, micro: int) -> Home:
    """Make a furnished home, which is the same for the same (macro, micro) on every machine."""
    floor = _floor(macro, micro)
    rng: np.random.Generator = stream(0, "home", NAME, macro, micro)
    # With the built-in templates, whose sizes the styles share; the style comes afterwards.
    home = furnish(bare_floor(floor), floor.plan, rng, KEEP_CLEAR_M)
    style = STYLES[micro // 10]
    props = tuple(replace(at, template=restyled(at.template, style)) for at in home.props)
    return replace(home, props=props)


def restyled(template: str, style: FurnitureStyle) -> str:
    """Return the name of a template in a style."""
    return f"{style.name}_{RESTYLED[template]}" if template in RESTYLED else template


def style_props(style: FurnitureStyle) -> dict[str, Prop]:
    """Return the templates of a style by name."""
    props = builtin_props()
    found = {}
    for template in RESTYLED:
        prop = props[template]
        geoms = tuple(
            replace(geom, material=style.coverings.get(geom.material, geom.material))
            for geom in prop.geoms
        )
        name = restyled(template, style)
        found[name] = replace(prop, name=name, geoms=geoms)
    return found


def style_roles() -> Roles:
    """Return the roles of the built-in furniture, with the corresponding templates of all styles added."""
    return replace(
        ROLES, places={role: _renamed(places) for role, places in ROLES.places.items()}
    )


def _renamed(places: Sequence[str]) -> tuple[str, ...]:
    names: list[str] = []
    for place in places:
        template, slash, rest = place.partition("/")
        if template in RESTYLED:
            names += [f"{restyled(template, style)}{slash}{rest}" for style in STYLES]
        else:
            names.append(place)
    return tuple(names)


@cache
def styles_pack() -> Pack:
    """Return the pack; always the same object."""
    props = {name: prop for name, prop in builtin_props().items() if name not in RESTYLED}
    for style in STYLES:
        props |= style_props(style)
    return Pack(
        NAME,
        props,
        builtin_articulations(),
        cached_homes(NAME, KEYS, bare_home, make_home),
        builtin_objects(),
        {**furniture_meshes(), **object_meshes()},
        style_roles(),
    )


SOURCE = PackSource(NAME, lambda request: styles_pack())
