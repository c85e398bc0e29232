"""The built-in homes: five macro layouts (floor plans), each with micro layouts (arrangements of the furniture).

Macro layouts 0, 1, 2 are in split train, 3 in val, 4 in test, as in ReplicaCAD's staged scenes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.core.seeding import stream
from mjhab.scenes.builtin.furniture import builtin_articulations, builtin_props
from mjhab.scenes.builtin.home_cache import cached_homes
from mjhab.scenes.builtin.home_plans import HARD, PLANS, SMALL, Piece, Plan, Wall
from mjhab.scenes.freespace import NAVMESH_BASE_RADIUS_M, free_map, reach
from mjhab.scenes.shapes.footprints import FloorPolygon, footprint, rectangle
from mjhab.scenes.shapes.shapes import span
from mjhab.scenes.spec import Articulation, Geom, Home, Light, Pack, Placement, Prop

NUM_MICROS = 21
"""Micro layouts per macro layout."""
WALL_HEIGHT_M = 2.6
WALL_THICKNESS_M = 0.12
Key = tuple[int, int]
EVERY: tuple[Key, ...] = tuple(
    (macro, micro) for macro in range(len(PLANS)) for micro in range(NUM_MICROS)
)
"""(macro, micro) of all 105 homes."""
LISTED = EVERY
"""(macro, micro) of the homes that the pack lists."""

MAX_REACH_TO_CENTER_M = 0.85
"""Largest planar distance of the centre of a receptacle from the nearest place where a base can stand [m]."""
MAX_REACH_TO_ANY_POINT_M = 1.0
"""Largest planar distance of any point of a receptacle from the nearest place where a base can stand [m]."""
MIN_CONNECTED_SHARE = 0.94
"""Smallest fraction of the free floor that must be connected; the rest are gaps behind furniture."""

Zone = tuple[tuple[float, float], tuple[float, float]]
KEEP_CLEAR_M: dict[str, Zone] = {
    "kitchen_counter": ((0.40, 1.95), (-1.40, 1.40)),
    "fridge": ((0.42, 1.90), (-0.80, 1.15)),
}
"""x and y extents [m] of the floor in front of an articulation, in its frame, that is kept free for doors and robot."""
FRIDGE_HALF_WIDTH_M = 0.345
"""Half the width of the fridge [m]."""

# Largest change of a piece's pose by a micro layout: along its own x and y axes [m], rotation [rad].
_SHIFTS: dict[str, tuple[float, float, float]] = {
    "table_01": (0.10, 0.12, 0.06),
    "chair_01": (0.06, 0.08, 0.30),
    "table_02": (0.10, 0.12, 0.10),
    "rug_01": (0.10, 0.15, 0.08),
    "rug_02": (0.10, 0.15, 0.08),
}
_ALONG_WALL = (0.0, 0.12, 0.0)
_SMALL_SHIFT = (0.05, 0.05, math.pi)
_MAX_TRIES = 400


def split_of(macro: int) -> Literal["train", "val", "test"]:
    """Return the split of a macro layout."""
    return "train" if macro < 3 else ("val" if macro == 3 else "test")


def builtin_homes(keys: Sequence[Key] = LISTED) -> tuple[Home, ...]:
    """Return the homes of the built-in pack, from the cache on disk if they were furnished before.

    Args:
        keys: (macro, micro) of the homes.
    """
    return cached_homes("builtin", keys, bare_home, make_home)


@cache
def make_home(macro: int, micro: int) -> Home:
    """Make a furnished home, which is the same for the same arguments on every machine.

    Args:
        macro: 0..4, determines walls, kitchen and the positions of large furniture.
        micro: 0..20, seed of the arrangement of the furniture; 0 is the plan unchanged.

    Raises:
        UsageError: an argument is out of range.
    """
    # Seed 0 for all: the homes of the pack are fixed, whatever the seed of a run.
    rng = stream(0, "home", macro, micro)
    plan = plan_of(macro, micro)
    return furnish(bare_home(macro, micro), plan, rng, keep_clear(macro, micro))


def bare_home(macro: int, micro: int) -> Home:
    """Make a home with walls, kitchen and lamps, but without props; arguments and errors as in `make_home`."""
    hard = HARD.get((macro, micro))
    name = f"builtin_m{macro}_{micro:02d}"
    floor = Floor(name, "builtin", split_of(macro), macro, micro, plan_of(macro, micro))
    home = bare_floor(floor)
    return replace(home, note=hard.note, open_limits=hard.limits) if hard else home


@dataclass(frozen=True)
class Floor:
    """Input for a home: names of home and pack, split, layout numbers, and plan."""

    name: str
    pack: str
    split: Literal["train", "val", "test"]
    macro: int
    micro: int
    plan: Plan


def bare_floor(floor: Floor) -> Home:
    """Make a home with the walls, kitchen and lamps of a plan, but without props."""
    plan = floor.plan
    width, depth = plan.size
    kitchen = tuple(_place(p) for p in plan.kitchen)
    rooms = tuple(
        # A millimetre above the floor, else the two surfaces would flicker in images.
        span(_x(r.extent), _y(r.extent), (-0.02, 0.001), r.floor, collide=False)
        for r in plan.rooms
    )
    return Home(
        floor.name,
        floor.pack,
        floor.split,
        floor.macro,
        floor.micro,
        wall_geoms(plan),
        (0.0, 0.0, width, depth),
        plan.rooms[0].floor,
        (),
        kitchen,
        _lights(plan),
        rooms,
    )


def plan_of(macro: int, micro: int) -> Plan:
    """Return the plan of a home: that of the macro layout, with the fridge moved in hard cases.

    Raises:
        UsageError: an argument is out of range.
    """
    if not (0 <= macro < len(PLANS) and 0 <= micro < NUM_MICROS):
        raise UsageError(
            f"no home ({macro}, {micro}): macro is 0..{len(PLANS) - 1}, micro 0..{NUM_MICROS - 1}."
        )
    plan = PLANS[macro]
    hard = HARD.get((macro, micro))
    return replace(plan, kitchen=(plan.kitchen[0], hard.fridge)) if hard else plan


def _x(extent: tuple[float, float, float, float]) -> tuple[float, float]:
    return extent[0], extent[2]


def _y(extent: tuple[float, float, float, float]) -> tuple[float, float]:
    return extent[1], extent[3]


def _lights(plan: Plan) -> tuple[Light, ...]:
    """One lamp under the ceiling of each room."""
    return tuple(
        Light(((e[0] + e[2]) / 2, (e[1] + e[3]) / 2, 2.4), intensity=1.0)
        for e in (room.extent for room in plan.rooms)
    )


def _place(piece: Piece) -> Placement:
    return Placement(piece[0], (piece[1], piece[2], 0.0), math.radians(piece[3]))


def wall_geoms(plan: Plan) -> tuple[Geom, ...]:
    """Compute the wall boxes of a plan: four outer walls around the floor, then inner walls split at doorways."""
    (w, d) = plan.size
    t = WALL_THICKNESS_M
    outer = [
        span((-t, w + t), (-t, 0.0), (0.0, WALL_HEIGHT_M), plan.outer_wall),
        span((-t, w + t), (d, d + t), (0.0, WALL_HEIGHT_M), plan.outer_wall),
        span((-t, 0.0), (0.0, d), (0.0, WALL_HEIGHT_M), plan.outer_wall),
        span((w, w + t), (0.0, d), (0.0, WALL_HEIGHT_M), plan.outer_wall),
    ]
    return (
        *outer,
        *(geom for wall in plan.walls for geom in _inner_wall(wall, plan.inner_wall)),
    )


def _inner_wall(wall: Wall, material: str) -> list[Geom]:
    stops = [wall.start, *(s for gap in wall.gaps for s in gap), wall.end]
    across = (wall.at - WALL_THICKNESS_M / 2, wall.at + WALL_THICKNESS_M / 2)
    pieces = []
    for a, b in zip(stops[::2], stops[1::2], strict=True):
        x, y = ((a, b), across) if wall.axis == "x" else (across, (a, b))
        pieces.append(span(x, y, (0.0, WALL_HEIGHT_M), material))
    return pieces


def furnish(
    home: Home, plan: Plan, rng: np.random.Generator, clear: dict[str, Zone]
) -> Home:
    """Add props to a home such that nothing overlaps, clear zones stay free, and a robot reaches every receptacle.

    Args:
        home: a home without props; if its micro number is 0, the plan is used unchanged.
        plan: its plan.
        rng: random generator of the arrangement.
        clear: zone in front of each articulation, by name.

    Raises:
        RuntimeError: no arrangement was found (an error in the plan; tests build every home).
    """
    # What is fixed is the same in all tries.
    taken = _blocked(plan, clear)
    for _ in range(_MAX_TRIES):
        # A copy of the list, as each try adds its pieces.
        placed = _try_furnish(plan, home.micro, rng, list(taken))
        if placed is not None:
            furnished = replace(home, props=placed)
            # The costly check comes last: it makes a map of the free floor.
            if usable(furnished, _templates_pack()):
                return furnished
    raise RuntimeError(
        f"{home.name}: no usable arrangement of the furniture in {_MAX_TRIES} tries"
    )


def usable(home: Home, pack: Pack) -> bool:
    """Return whether the free floor is connected (see `MIN_CONNECTED_SHARE`) and every receptacle is in reach of it."""
    free = free_map(home, pack)
    share = free.navigable().sum() / max(
        (free.clearance >= NAVMESH_BASE_RADIUS_M).sum(), 1
    )
    # A piece before a doorway would cut a room off without overlapping anything.
    return bool(share >= MIN_CONNECTED_SHARE) and all(
        r.center <= MAX_REACH_TO_CENTER_M and r.farthest <= MAX_REACH_TO_ANY_POINT_M
        for r in reach(home, pack, free)
    )


def _try_furnish(
    plan: Plan, micro: int, rng: np.random.Generator, taken: list[FloorPolygon]
) -> tuple[Placement, ...] | None:
    # Micro layout 0 is the plan as it was drawn.
    order = np.arange(len(plan.spots)) if micro == 0 else rng.permutation(len(plan.spots))
    small = [
        _place((name, *plan.spots[k])) for name, k in zip(SMALL, order, strict=False)
    ]
    result: list[Placement] = []
    for group, tries in (
        # Largest and fixed pieces first: small ones find a place beside them, but not the other way round.
        ([_place(p) for p in plan.fixed], 1),
        ([_place(p) for p in plan.loose], 12),
        (small, 12),
    ):
        for placement in group:
            spot = _settle(placement, taken, rng, 1 if micro == 0 else tries)
            if spot is None:
                return None
            result.append(spot)
    return tuple(result)


def keep_clear(macro: int, micro: int) -> dict[str, Zone]:
    """Return the clear zone in front of each articulation of a home, cut off at a wall beside the fridge."""
    hard = HARD.get((macro, micro))
    if hard is None:
        return KEEP_CLEAR_M
    x, (low, high) = KEEP_CLEAR_M["fridge"]
    return {
        **KEEP_CLEAR_M,
        # Beyond the wall there is nothing to keep clear.
        "fridge": (x, (low, min(high, FRIDGE_HALF_WIDTH_M + hard.side))),
    }


def _blocked(plan: Plan, clear: dict[str, Zone]) -> list[FloorPolygon]:
    """Footprints of walls, kitchen and clear zones, which props must not overlap."""
    taken = []
    for wall in wall_geoms(plan):
        (x, y, _) = wall.pos
        (hx, hy, hz) = wall.size
        corners = rectangle(Placement("wall", (x, y, 0.0)), (-hx, hx), (-hy, hy))
        taken.append(FloorPolygon("wall", corners, (0.0, 2 * hz)))
    for piece in plan.kitchen:
        at = _place(piece)
        body = footprint(at, _template(at.template))
        assert body is not None
        taken.append(body)
        taken.append(
            FloorPolygon("zone", rectangle(at, *clear[at.template]), (0.0, WALL_HEIGHT_M))
        )
    return taken


@cache
def _templates_pack() -> Pack:
    return Pack("builtin", builtin_props(), builtin_articulations(), (), {})


def _template(name: str) -> Prop | Articulation:
    pack = _templates_pack()
    return pack.props.get(name) or pack.articulations[name]


def _settle(
    placement: Placement, taken: list[FloorPolygon], rng: np.random.Generator, tries: int
) -> Placement | None:
    """Sample shifted poses until one is free and append its footprint to ``taken``; None after ``tries`` failures."""
    movable = tries > 1
    for _ in range(tries):
        pose = _shift(placement, rng) if movable else placement
        area = footprint(pose, _template(pose.template))
        # Pictures and rugs take no room.
        if area is None:
            return pose
        if not any(area.meets(other) for other in taken):
            taken.append(area)
            return pose
    return None


def _shift(placement: Placement, rng: np.random.Generator) -> Placement:
    small = placement.template in SMALL
    across, along, turn = (
        _SMALL_SHIFT if small else _SHIFTS.get(placement.template, _ALONG_WALL)
    )
    # Always three numbers, so that pieces that do not turn leave the stream where others would.
    a, b, yaw = (rng.uniform(-1.0, 1.0, 3) * (across, along, turn)).tolist()
    c = math.cos(placement.yaw)
    s = math.sin(placement.yaw)
    x, y, z = placement.pos
    return Placement(
        placement.template, (x + c * a - s * b, y + s * a + c * b, z), placement.yaw + yaw
    )
