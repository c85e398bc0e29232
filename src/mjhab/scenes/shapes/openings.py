"""Opening ranges: how far doors and drawers open before they collide with a wall or furniture, without a simulator."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np

from mjhab.core.rotations import mat_from_quat
from mjhab.scenes.shapes.footprints import FloorPolygon, all_geoms, outline
from mjhab.scenes.shapes.hulls import hull_from_above
from mjhab.scenes.spec import Geom, Home, Link, Pack, Placement

_SWEEP_POSES = 24
"""Number of sampled joint positions; a door of 0.7 m moves 7 cm between them, less than the thickness of walls."""
_BISECTIONS = 12
"""Bisection steps between the last free and the first colliding sample."""
_LIMIT_MARGIN_RAD = 0.005
"""Least distance of a limit from the wall [rad]."""
_SKIN_M = 1e-3
"""Vertical overlap that does not count as a collision [m], because pieces may stand flush."""


def free_travel(home: Home, pack: Pack) -> dict[str, float]:
    """Compute how far every link of a home opens without a collision, with all others closed.

    Collisions with its own body do not count.

    Returns:
        Joint position [m or rad] by link id ``"<articulation>/<link>"``; the end of the range if it opens fully.
    """
    result: dict[str, float] = {}
    for placement in home.articulations:
        around = solids_near(home, pack, placement)
        for link in pack.articulations[placement.template].links:
            result[f"{placement.template}/{link.name}"] = travel(link, placement, around)
    return result


def wall_limits(homes: Iterable[Home], pack: Pack) -> list[tuple[tuple[str, float], ...]]:
    """Compute `Home.open_limits` of homes: hinged links that a wall stops, and where they do not touch it yet [rad]."""
    # Homes of one floor plan have the same walls, and most of their furniture stands in the same places.
    known: dict[tuple[Geom, ...], tuple[list[FloorPolygon], dict[Placement, Any]]] = {}
    found = []
    for home in homes:
        if home.walls not in known:
            known[home.walls] = _walls(home), {}
        walls, limits = known[home.walls]
        for placement in home.articulations:
            if placement not in limits:
                limits[placement] = tuple(_stopped_by(walls, placement, pack))
        found.append(tuple(chain(*(limits[piece] for piece in home.articulations))))
    return found


def _stopped_by(
    walls: Sequence[FloorPolygon], placement: Placement, pack: Pack
) -> Iterator[tuple[str, float]]:
    """Hinged links of a placed piece of furniture that walls stop, and where they do not touch them yet [rad]."""
    for link in pack.articulations[placement.template].links:
        free = travel(link, placement, walls) if link.joint == "hinge" else np.inf
        if link.range[0] < free < link.range[1]:
            # Rounded down: two decimals for people to read, and never past the wall.
            limit = np.floor((free - _LIMIT_MARGIN_RAD) * 100) / 100
            yield f"{placement.template}/{link.name}", float(limit)


def stuck_links(home: Home, pack: Pack) -> list[str]:
    """Describe every link that cannot open to the end of its range, or to the home's limit for it, in one phrase."""
    stated = dict(home.open_limits)
    full = _ends(pack)
    found = []
    for name, free in free_travel(home, pack).items():
        wanted = stated.get(name, full[name])
        if free < wanted - 1e-6:
            found.append(f"{name} opens to {free:.2f} of {wanted:.2f}")
    return found


def met_walls(home: Home, pack: Pack) -> list[str]:
    """Describe in one phrase every link that, as the home says, a wall stops."""
    full = _ends(pack)
    return [
        f"{name} meets a wall: no episode starts beyond {limit:.2f} of {full[name]:.2f}; joint_dynamics 'ours' ends "
        "the joint there, 'published' lets the door run against the wall"
        for name, limit in home.open_limits
        if name in full
    ]


def _ends(pack: Pack) -> dict[str, float]:
    """End of the range of every link of a pack [m or rad], by id."""
    return {
        f"{thing.name}/{link.name}": link.range[1]
        for thing in pack.articulations.values()
        for link in thing.links
    }


def travel(link: Link, at: Placement, around: Sequence[FloorPolygon]) -> float:
    """Joint position [m or rad] to which a link of placed furniture opens before it meets one of the areas ``around``;
    the end of its range if it meets none."""
    low, high = link.range
    pieces = [_flat(g, link, at.pos[2]) for g in link.geoms if g.collide]
    # A hundred walls are around, and a link is near two of them: their boxes are compared all at once.
    x_min, y_min, x_max, y_max = np.array([p.box for p in around]).reshape(-1, 4).T

    def free(q: float) -> bool:
        for corners, z in pieces:
            piece = FloorPolygon(link.name, _moved(corners, link, at, q), z)
            left, front, right, back = piece.box
            near = (x_min <= right) & (left <= x_max) & (y_min <= back) & (front <= y_max)
            if any(piece.meets(around[k]) for k in np.flatnonzero(near).tolist()):
                return False
        return True

    good = low
    # In order, because a door does not jump over a wall to the free range behind it.
    for q in np.linspace(low, high, _SWEEP_POSES + 1)[1:].tolist():
        if not free(q):
            return _last_free(free, good, q)
        good = q
    return high


def _last_free(free: Callable[[float], bool], good: float, bad: float) -> float:
    for _ in range(_BISECTIONS):
        middle = (good + bad) / 2
        good, bad = (middle, bad) if free(middle) else (good, middle)
    return good


def link_outline(link: Link, at: Placement, q: float) -> np.ndarray:
    """Points (N, 2) [m] in the world around the solid parts of a link of placed furniture at joint position ``q``."""
    pieces = [_flat(g, link, at.pos[2])[0] for g in link.geoms if g.collide]
    return _moved(np.concatenate(pieces), link, at, q)


def _flat(geom: Geom, link: Link, lift: float) -> tuple[np.ndarray, tuple[float, float]]:
    """Convex outline (N, 2) in the frame of the link, height interval in the world [m]; the piece must be upright."""
    points = outline(geom)
    z = points[:, 2] + link.pos[2] + lift
    # Doors end at the height of the plinth and of the worktop, and do not touch them.
    height = float(z.min()) + _SKIN_M, float(z.max()) - _SKIN_M
    return hull_from_above(points), height


def _moved(corners: np.ndarray, link: Link, at: Placement, q: float) -> np.ndarray:
    """World positions (N, 2) [m] of ``corners`` (N, 2), given in the frame of a link, at joint position q."""
    slides = link.joint == "slide"
    local = (
        corners + q * np.array(link.axis[:2])
        if slides
        else corners @ _turn(q * link.axis[2])
    )
    return (local + np.array(link.pos[:2])) @ _turn(at.yaw) + np.array(at.pos[:2])


def _turn(angle: float) -> np.ndarray:
    c = np.cos(angle)
    s = np.sin(angle)
    return np.array([[c, s], [-s, c]])


def solids_near(
    home: Home, pack: Pack, piece: Placement, *, closed: bool = False
) -> list[FloorPolygon]:
    """Footprints of walls, and of other furniture within 3 m of a placed piece.

    Args:
        home, pack: the home.
        piece: the piece.
        closed: with the piece itself and with all doors and drawers, closed; else without either.
    """
    solid = _walls(home)
    # Farther than any door or drawer reaches.
    near = 3.0
    for placement in (*home.props, *home.articulations):
        apart = np.hypot(*np.subtract(placement.pos[:2], piece.pos[:2]))
        if apart > near or (placement == piece and not closed):
            continue
        template = (
            pack.props.get(placement.template) or pack.articulations[placement.template]
        )
        geoms = all_geoms(template) if closed else template.geoms
        solid += [
            _solid(g, placement, pack.meshes, placement.template)
            for g in geoms
            if g.collide
        ]
    return solid


def _walls(home: Home) -> list[FloorPolygon]:
    here = Placement("", (0.0, 0.0, 0.0))
    return [_solid(g, here, {}, "wall") for g in home.walls if g.collide]


def _solid(
    geom: Geom, at: Placement, meshes: Mapping[str, object], name: str
) -> FloorPolygon:
    points = outline(geom, meshes) @ mat_from_quat(np.array(at.rotation)).T + np.array(
        at.pos
    )
    height = float(points[:, 2].min()), float(points[:, 2].max())
    return FloorPolygon(name, hull_from_above(points), height)
