"""Checks of homes from home files: sizes, overlaps, free floor, and reach of the receptacles with roles."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from mjhab.core.errors import about, fault
from mjhab.core.rotations import mat_from_quat
from mjhab.scenes.builtin.homes import MAX_REACH_TO_CENTER_M
from mjhab.scenes.freespace import NAVMESH_BASE_RADIUS_M, free_map, reach
from mjhab.scenes.pack_check import check_range
from mjhab.scenes.roles import plays, roles_of
from mjhab.scenes.shapes.footprints import FloorPolygon, footprint, outline
from mjhab.scenes.spec import Home, Pack, Placement

MIN_FLOOR_M = 1.5
"""Smallest side of the floor of a home [m]."""
MAX_FLOOR_M = 40.0
"""Largest side of the floor of a home [m]."""
MAX_WALL_THICKNESS_M = 1.0
MAX_WALL_HEIGHT_M = 6.0
OUTER_WALLS = 4
"""Number of walls around the floor, which come first in `Home.walls`."""
MAX_OVERLAP_M = 0.001
"""Depth to which pieces may overlap [m], because files have few digits."""
MAX_SURFACE_HEIGHT_M = 1.6
"""Largest height of a receptacle with a role [m]; the highest in the built-in furniture is in the fridge, 1.53 m."""


def check_home(source: Path, pack: Pack, home: Home) -> None:
    """Check sizes, overlaps, free floor and reach of a home.

    Args:
        source: file of the home, for messages.
        pack: has the templates of the furniture.
        home: the home.

    Raises:
        UsageError: the home fails a check, see `mjhab.scenes.home_files.home_pack`.
    """
    # Numbers first: footprints of absurd sizes would exhaust memory.
    with about(source):
        _check_numbers(home)
    _check_singles(source, home)
    _check_overlaps(source, pack, home)
    _check_reach(source, pack, home)


def _check_numbers(home: Home) -> None:
    _, _, width, depth = home.floor
    check_range("floor.size", (width, depth), MIN_FLOOR_M, MAX_FLOOR_M, "m")
    for wall in home.walls:
        check_range("walls.height", 2 * wall.size[2], 0.1, MAX_WALL_HEIGHT_M, "m")
    check_range(
        "walls.thickness",
        2 * min(home.walls[0].size[:2]),
        0.01,
        MAX_WALL_THICKNESS_M,
        "m",
    )
    for placement in (*home.props, *home.articulations):
        x, y, _ = placement.pos
        where = f"furniture {placement.template!r}"
        check_range(f"{where}, x of at", x, 0.0, width, "m")
        check_range(f"{where}, y of at", y, 0.0, depth, "m")
        check_range(
            f"{where}, yaw_degrees", math.degrees(placement.yaw), -360.0, 360.0, "degrees"
        )
    for wall in home.walls:
        reach_m = max(width, depth) + MAX_WALL_THICKNESS_M
        check_range("walls.inner", wall.pos[:2], -MAX_WALL_THICKNESS_M, reach_m, "m")


def _check_singles(source: Path, home: Home) -> None:
    names = [placement.template for placement in home.articulations]
    for name in names:
        if names.count(name) > 1:
            raise fault(
                source,
                f"furniture: {name!r} stands {names.count(name)} times; a home may have one of each kind that opens.",
            )


def _check_overlaps(source: Path, pack: Pack, home: Home) -> None:
    """Raise a UsageError if a piece overlaps a wall or another piece."""
    taken = [
        (
            "walls.outer" if k < OUTER_WALLS else "a wall of walls.inner",
            _wall_area(home, k),
        )
        for k in range(len(home.walls))
    ]
    for placement in (*home.props, *home.articulations):
        template = (
            pack.props.get(placement.template) or pack.articulations[placement.template]
        )
        area = footprint(placement, template)
        if area is None:
            continue
        # Pieces in files stand flush with walls, up to a digit.
        area = _shrunk(area)
        name = _named(placement)
        for other, space in taken:
            if area.meets(space):
                raise fault(
                    source, f"furniture: {name} overlaps {other}; move one of them."
                )
        taken.append((name, area))


def _named(placement: Placement) -> str:
    x, y, _ = placement.pos
    return f"{placement.template!r} at [{x:g}, {y:g}]"


def _shrunk(area: FloorPolygon) -> FloorPolygon:
    """A footprint shrunk by `MAX_OVERLAP_M` on every side."""
    middle = area.corners.mean(axis=0)
    away = area.corners - middle
    size = np.linalg.norm(away, axis=1, keepdims=True)
    # Corners move along the diagonal, by the square root of 2 times what sides move.
    corners = middle + away * np.maximum(1.0 - np.sqrt(2.0) * MAX_OVERLAP_M / size, 0.0)
    low, high = area.z
    return FloorPolygon(area.name, corners, (low + MAX_OVERLAP_M, high - MAX_OVERLAP_M))


def _wall_area(home: Home, index: int) -> FloorPolygon:
    wall = home.walls[index]
    points = outline(wall)
    half = np.array(wall.size[:2])
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    turn = mat_from_quat(np.array(wall.quat))[:2, :2]
    corners = (signs * half) @ turn.T + np.array(wall.pos[:2])
    return FloorPolygon(
        "wall", corners, (float(points[:, 2].min()), float(points[:, 2].max()))
    )


def _check_reach(source: Path, pack: Pack, home: Home) -> None:
    """Raise a UsageError if a robot has no free floor, or cannot reach a receptacle with a role."""
    free = free_map(home, pack)
    if not free.navigable().any():
        raise fault(
            source,
            f"furniture leaves no floor on which a base of radius {NAVMESH_BASE_RADIUS_M} m can stand.",
        )
    roles = roles_of(pack, home)
    for found in reach(home, pack, free):
        template = pack.props.get(found.thing) or pack.articulations[found.thing]
        first = template.receptacles[0].name == found.receptacle
        playing = [
            r
            for r in roles.places
            if plays(roles, r, found.thing, found.receptacle, first=first)
        ]
        if not playing:
            continue
        if not 0.0 <= found.height <= MAX_SURFACE_HEIGHT_M:
            raise fault(
                source,
                f"receptacle {found.receptacle!r} of {found.thing!r}, which plays the role {playing[0]!r}, is "
                f"{found.height:.2f} m above the floor; a robot reaches from 0 to {MAX_SURFACE_HEIGHT_M} m. "
                "Lower it, or give the role to another.",
            )
        if found.center > MAX_REACH_TO_CENTER_M:
            raise fault(
                source,
                f"receptacle {found.receptacle!r} of {found.thing!r}, which plays the role {playing[0]!r}, is "
                f"{found.center:.2f} m from where a robot can stand; it reaches {MAX_REACH_TO_CENTER_M} m. "
                "Make room before it, or give the role to another.",
            )
