"""Furniture that stands elsewhere: further versions of homes in which chairs and other loose pieces are moved.

No episode is drawn in a version: perturbations (`config.perturbing`) exchange the home of an episode for one. All of it
follows from the names of pack and home, the largest shift and the number of the version.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mjhab.core.rotations import pose_inv, pose_mul
from mjhab.core.seeding import stream
from mjhab.scenes.freespace import shared_map
from mjhab.scenes.shapes.footprints import FloorPolygon, bounds, meet, rectangle
from mjhab.scenes.shapes.openings import solids_near, travel
from mjhab.scenes.spec import PARKED, Home, Pack, Placement

MARK = "~moved"
"""Part of the names of versions, and of no other home's."""
MOVES_PER_HOME = 2
"""Versions of a home for each largest shift."""
LARGEST_M = 0.85
"""Furniture whose footprint is longer [m], or does not begin at the floor, stays."""
TALLEST_M = 1.9
"""So does what is taller [m]: cupboards."""
FLOOR_M = 0.05
"""A piece begins at the floor if its lowest point is at most so high [m]; what is lower is a rug."""
NEAR_M = 0.05
"""Least distance of a moved piece from objects on the floor [m]."""
LOW_M = 0.25
"""An object is on a surface if its middle is less than this above it [m]."""
LEAST_FLOOR = 0.9
"""Share of the floor of a home, where the base can go, that a version leaves in one piece."""
FARTHER_M = 0.15
"""In a version the base comes so near to a place as before, but for this distance [m]."""
_TRIES = 12
_LEAST_SHARE = 0.4
"""Least shift as a share of the largest one."""
_TURN_RAD = 0.6
"""Largest turn of a piece."""


def with_moved_furniture(
    pack: Pack, homes: Sequence[str], shifts: Iterable[float]
) -> Pack:
    """A pack with `MOVES_PER_HOME` more homes for each of ``homes`` and each largest shift [m], behind all others.

    A version in which nothing can be moved is left out. Equal arguments give the same object while the pack is held.
    """
    wanted = tuple(shifts)
    # The same pack, so that nothing else is compiled or hashed anew.
    if not wanted:
        return pack
    key = ("moved furniture", tuple(homes), wanted)
    return pack.derived.get(key, lambda: _extended(pack, homes, wanted))


def version_name(home: str, shift: float, number: int) -> str:
    """Name of a version of a home."""
    return f"{home}{MARK}{round(1000 * shift)}mm{number}"


def is_version(home: Home) -> bool:
    """Whether a home is a version of another one, in which no episodes are drawn."""
    return MARK in home.name


def moved_pieces(home: Home, version: Home) -> list[tuple[Placement, Placement]]:
    """The pieces that stand elsewhere in a version: where they were, and where they are."""
    pairs = zip(home.props, version.props, strict=True)
    return [(before, after) for before, after in pairs if before != after]


class Things(NamedTuple):
    """What the home of an episode must leave in place.

    Attributes:
        handled: (H, 3) where its targets are and are to be put [m].
        others: (N, 3) where its other objects are [m].
        handles: (L, 2) handles of the doors and drawers of its home [m].
    """

    handled: np.ndarray
    others: np.ndarray
    handles: np.ndarray


def is_possible(pack: Pack, home: Home, version: Home, things: Things) -> bool:
    """Whether an episode in ``home`` can take place in a version of it.

    Nothing that it handles may be on a piece that is moved, and no object on the floor where one comes to; doors and
    drawers open, and the base comes as near to all of it as before.
    """
    pairs = moved_pieces(home, version)
    areas = [_area(after, pack) for _, after in pairs]
    # Nobody handles the others, but a moved piece must not stand in them either.
    every = np.concatenate([things.handled, things.others])
    low = [_around(place[:2]) for place in every if place[2] < LOW_M]
    if any(meet(area.corners, square, NEAR_M) for area in areas for square in low):
        return False
    if any(standing(before, pack, things.handled).any() for before, _ in pairs):
        return False
    key = ("moved furniture opens", version.name)
    # In a tuple, since a cached False must differ from nothing cached.
    opens = pack.derived.get(key, lambda: (_opens(pack, version, areas),))[0]
    places = np.concatenate([things.handled[:, :2], things.handles])
    return opens and _leads(pack, home, version, places)


def carried(pack: Pack, home: Home, version: Home, poses: np.ndarray) -> np.ndarray:
    """Poses (N, 7) of objects in a version of a home: those that stand on a piece are moved with it."""
    found = poses.copy()
    for before, after in moved_pieces(home, version):
        on_it = standing(before, pack, poses[:, :3])
        old, new = (np.array([*at.pos, *at.rotation]) for at in (before, after))
        for k in np.flatnonzero(on_it):
            found[k] = pose_mul(new, pose_mul(pose_inv(old), poses[k]))
    return found


def standing(at: Placement, pack: Pack, places: np.ndarray) -> np.ndarray:
    """(P,) bool: which of the places (P, 3) [m] are on a receptacle of a placed piece."""
    cos, sin = np.cos(at.yaw), np.sin(at.yaw)
    local = places - np.array(at.pos)
    local[:, :2] = local[:, :2] @ np.array([[cos, -sin], [sin, cos]])
    found = np.zeros(len(places), bool)
    for receptacle in pack.props[at.template].receptacles:
        off = np.abs(local - np.array(receptacle.pos))
        found |= (off <= (*receptacle.half, LOW_M)).all(axis=1)
    return found


def _opens(pack: Pack, version: Home, areas: Sequence[FloorPolygon]) -> bool:
    """Whether all doors and drawers open in spite of what was moved."""
    return all(
        travel(link, at, areas) >= link.range[1]
        for at in version.articulations
        for link in pack.articulations[at.template].links
    )


def _leads(pack: Pack, home: Home, version: Home, places: np.ndarray) -> bool:
    """Whether the base comes as near to places (P, 2) [m] as before, and nearly everywhere else."""
    before_map, after_map = (shared_map(each, pack) for each in (home, version))
    before_free, after_free = before_map.navigable(), after_map.navigable()
    # The largest piece of free floor counts: a narrow gap that closes would cut rooms off.
    if after_free.sum() < LEAST_FLOOR * before_free.sum():
        return False
    old, new = (
        _nearest(space.to_xy(np.argwhere(free)), places)
        for space, free in ((before_map, before_free), (after_map, after_free))
    )
    # Some tolerance, because the maps have cells.
    return bool((new <= old + FARTHER_M).all())


def _nearest(cells: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Distance (P,) [m] of places (P, 2) from the nearest of cells (N, 2)."""
    return np.array([np.hypot(*(cells - place).T).min() for place in places])


def _around(place: np.ndarray) -> np.ndarray:
    """A small square (4, 2) [m] around a place (2,)."""
    # A polygon of no size would have no sides to separate.
    return place + 1e-3 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def _extended(pack: Pack, homes: Sequence[str], shifts: Sequence[float]) -> Pack:
    found: list[Home] = []
    for name in homes:
        home = pack.homes_by_name[name]
        # Once per home: all its versions begin with the same furniture.
        solids = _solids(home, pack)
        loose = _loose(home, pack)
        for shift in shifts:
            for number in range(MOVES_PER_HOME):
                found += _version(home, pack, (shift, number), loose, solids)
    return replace(pack, homes=(*pack.homes, *found))


def _solids(home: Home, pack: Pack) -> list[list[FloorPolygon]]:
    """Footprints of the geoms of every prop of a home, above rugs, and of all that stays, closed, in the last list."""
    bare = replace(home, walls=(), props=(), articulations=())
    found = [
        solids_near(replace(bare, props=(at,)), pack, at, closed=True)
        for at in home.props
    ]
    stays = solids_near(replace(bare, walls=home.walls), pack, Placement("", PARKED))
    for at in home.articulations:
        stays += solids_near(replace(bare, articulations=(at,)), pack, at, closed=True)
    return [[s for s in each if s.z[1] > FLOOR_M] for each in (*found, stays)]


def _version(
    home: Home,
    pack: Pack,
    which: tuple[float, int],
    loose: Sequence[int],
    solids: Sequence[list[FloorPolygon]],
) -> list[Home]:
    """The version of a home with a largest shift [m] and a number; [] if none of its pieces can be moved."""
    shift, number = which
    name = version_name(home.name, shift, number)
    props = list(home.props)
    now = list(solids)
    for k in loose:
        # A stream per piece, so that a piece that finds no room does not change where others go.
        random = stream(0, "moved furniture", home.pack, name, k)
        around = [solid for n, each in enumerate(now) if n != k for solid in each]
        # A piece that fits nowhere stays, which is no error: others are moved.
        for _ in range(_TRIES):
            length = shift * random.uniform(_LEAST_SHARE, 1.0)
            angle = random.uniform(-np.pi, np.pi)
            x, y, z = props[k].pos
            to = (x + length * float(np.cos(angle)), y + length * float(np.sin(angle)), z)
            turn = float(random.uniform(-_TURN_RAD, _TURN_RAD))
            moved = replace(props[k], pos=to, yaw=props[k].yaw + turn)
            area = _area(moved, pack)
            if not any(area.meets(solid) for solid in around):
                props[k] = moved
                now[k] = [area]
                break
    if tuple(props) == home.props:
        return []
    note = f"a version of {home.name}"
    return [replace(home, name=name, props=tuple(props), note=note)]


def _loose(home: Home, pack: Pack) -> list[int]:
    """Numbers of the pieces of a home that can be moved: small, on the floor, upright, with nothing on them."""
    found = []
    for k, at in enumerate(home.props):
        prop = pack.props[at.template]
        # Rugs and what lies tilted would not look moved, or would not stand.
        if not prop.blocks_base or at.quat is not None:
            continue
        if not any(geom.collide for geom in prop.geoms):
            continue
        low, high = bounds(prop.geoms, pack.meshes)
        size = high - low
        if low[2] + at.pos[2] > FLOOR_M or size[2] > TALLEST_M:
            continue
        if size[:2].max() > LARGEST_M:
            continue
        area = _area(at, pack)
        on_it = (
            meet(area.corners, _around(np.array(other.pos[:2])))
            for other in home.props
            # What stands on a piece is a piece of its own, and would be left in the air.
            if other is not at and other.pos[2] > FLOOR_M
        )
        if not any(on_it):
            found.append(k)
    return found


def _area(at: Placement, pack: Pack) -> FloorPolygon:
    """The area of a placed piece, above rugs."""
    low, high = bounds(pack.props[at.template].geoms, pack.meshes)
    corners = rectangle(at, (low[0], high[0]), (low[1], high[1]))
    return FloorPolygon(at.template, corners, (FLOOR_M, float(high[2] + at.pos[2])))
