"""Walls beside doors: further versions of the homes of split train, in each of which a door opens toward a wall.

In few homes a wall stops a door on its way (`Home.open_limits`), and a policy that never met one drives where the wall
is. In a version of a home a panel stands on the side of the hinges of one of its doors, at a drawn distance, so that
the door meets it between `LEAST_SHARE` and the end of its range. The panel begins in front of what stands beside the
door, and its length is drawn, too. All of it follows from the names of pack and home and the number of the version.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjhab.core.seeding import stream
from mjhab.scenes.roles import roles_of
from mjhab.scenes.shapes.footprints import FloorPolygon
from mjhab.scenes.shapes.openings import (
    link_outline,
    solids_near,
    travel,
    wall_limits,
)
from mjhab.scenes.shapes.shapes import about_z
from mjhab.scenes.spec import Geom, Home, Link, Pack, Placement

LEAST_SHARE = 0.755
"""Least opening at which the panel stops the door, as a fraction of its range: Open asks for 0.75."""
THICKNESS_M = 0.1
PASSAGE_M = 0.65
"""Free floor past the end of the panel and to its sides there [m], so that it divides no room: a base is 0.6 m wide."""
BEYOND_DOOR_M = (0.0, 1.2)
"""Least and largest length of the panel beyond the reach of the door [m]."""
_GAP_M = 0.02
"""Distance of the panel from what stands behind it [m]."""
_FACE_SHARE = 0.6
"""The panel begins before this fraction of the reach of the door, which so meets its face rather than its end."""
_TRIES = 16
_RUG_M = 0.05
"""What is lower does not count as met [m]."""
_HEIGHT_M = 2.6
"""Height of the panel in a home without walls [m]."""
_EARLY_RAD = 0.02
"""A panel that stops the door earlier by this meets it on its way."""
_MATERIAL = "wall_white"


def with_door_walls(pack: Pack, versions: int) -> Pack:
    """Return a pack with ``versions`` more homes behind every home of train, named ``<home>_wall<number>``.

    A version for which no valid panel is found in some draws is left out. A valid one meets nothing and leaves a
    passage of `PASSAGE_M`. Drawers pass through it, as through all walls. Equal arguments give the same object while
    the pack is held.
    """
    # The same object, so that nothing that is cached for the pack is made anew.
    if not versions:
        return pack
    return pack.derived.get(("door walls", versions), lambda: _extended(pack, versions))


def _extended(pack: Pack, versions: int) -> Pack:
    homes: list[Home] = []
    for home in pack.homes:
        homes.append(home)
        if home.split == "train":
            homes += _versions(home, pack, versions)
    return replace(pack, homes=tuple(homes))


def _versions(home: Home, pack: Pack, versions: int) -> Iterator[Home]:
    """The versions of a home for which a valid panel is drawn."""
    doors = _doors(home, pack)
    around = {door.at: solids_near(home, pack, door.at, closed=True) for door in doors}
    for number in range(versions if doors else 0):
        # Per version, so that more versions leave the first ones as they are.
        rng = stream(0, "door wall", home.pack, home.name, number)
        for _ in range(_TRIES):
            door = doors[rng.integers(len(doors))]
            limit = door.link.range[1] * rng.uniform(LEAST_SHARE, 1.0)
            length = rng.uniform(*BEYOND_DOOR_M)
            panel = _panel(door, limit, length, around[door.at])
            if panel is None:
                continue
            top = max((g.pos[2] + g.size[2] for g in home.walls), default=_HEIGHT_M)
            wall = _wall(panel, door, top)
            yield replace(
                home,
                name=f"{home.name}_wall{number}",
                walls=(*home.walls, wall),
                open_limits=_limits(home, pack, wall),
                note=f"a wall stands beside {door.id} (door_walls)",
            )
            break


def _doors(home: Home, pack: Pack) -> list[_Door]:
    """The doors of a home that have a role; all of them if none has."""
    doors = [
        _Door(at, link)
        for at in home.articulations
        for link in pack.articulations[at.template].links
        if link.joint == "hinge"
    ]
    roles = roles_of(pack, home).links.values()
    # Doors that no task opens would make versions that differ in nothing that matters.
    return [door for door in doors if door.id in roles] or doors


@dataclass(frozen=True, eq=False)
class _Door:
    """A hinged link of placed furniture, seen from its hinge."""

    at: Placement
    link: Link

    @property
    def id(self) -> str:
        return f"{self.at.template}/{self.link.name}"

    @cached_property
    def axes(self) -> np.ndarray:
        """(2, 2) rows: unit vectors in the world out of the front, and from the hinge away from the closed door."""
        out = np.array(self.link.handle.out[:2])
        out = out / np.linalg.norm(out, axis=-1)
        away = np.array([out[1], -out[0]])
        # The handle is on the side of the door that is far from the hinge.
        away *= -np.sign(away @ np.array(self.link.handle.pos[:2]))
        cos, sin = np.cos(self.at.yaw), np.sin(self.at.yaw)
        return np.array([out, away]) @ np.array([[cos, sin], [-sin, cos]])

    @cached_property
    def hinge(self) -> np.ndarray:
        """(2,) its position in the world [m]."""
        cos, sin = np.cos(self.at.yaw), np.sin(self.at.yaw)
        turned = np.array([[cos, -sin], [sin, cos]]) @ np.array(self.link.pos[:2])
        return turned + np.array(self.at.pos[:2])

    def local(self, points: np.ndarray) -> np.ndarray:
        """Positions (N, 2) [m] out of the front and away from the hinge, of ``points`` (N, 2) in the world."""
        return (points - self.hinge) @ self.axes.T

    def area(
        self, along: tuple[float, float], across: tuple[float, float]
    ) -> FloorPolygon:
        """The area with these extents of `local`, from above rugs up."""
        (u0, u1), (v0, v1) = along, across
        corners = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])
        return FloorPolygon(
            "panel", corners @ self.axes + self.hinge, (_RUG_M, _HEIGHT_M)
        )


def _panel(
    door: _Door, limit: float, length: float, around: Sequence[FloorPolygon]
) -> FloorPolygon | None:
    """A panel that stops a door at ``limit`` [rad] and is ``length`` [m] longer than the door reaches.

    None if it meets or shuts off something of ``around`` in front of the door, or stops the door earlier.
    """
    opened = door.local(link_outline(door.link, door.at, limit))
    reach = float(np.linalg.norm(opened, axis=1).max())
    face = float(opened[:, 1].max())
    end = reach + length
    whole = door.area((-reach, end), (face, face + THICKNESS_M))
    # The furniture itself stands there as well: the panel begins in front of all of it.
    met = [door.local(s.corners)[:, 0].max() for s in around if s.meets(whole)]
    start = max([-reach, *(float(front) + _GAP_M for front in met)])
    sides = (face - PASSAGE_M, face + THICKNESS_M + PASSAGE_M)
    passage = door.area((end, end + PASSAGE_M), sides)
    if start > _FACE_SHARE * reach or any(solid.meets(passage) for solid in around):
        return None
    panel = door.area((start, end), (face, face + THICKNESS_M))
    return panel if travel(door.link, door.at, [panel]) > limit - _EARLY_RAD else None


def _limits(home: Home, pack: Pack, wall: Geom) -> tuple[tuple[str, float], ...]:
    """`Home.open_limits` of a home with one more wall."""
    limits = dict(home.open_limits)
    (found,) = wall_limits([replace(home, walls=(wall,))], pack)
    for name, limit in found:
        # Walls of the home may stop another door before.
        limits[name] = min(limit, limits.get(name, limit))
    return tuple(limits.items())


def _wall(panel: FloorPolygon, door: _Door, top: float) -> Geom:
    """The wall on the area of a panel, up to ``top`` [m]."""
    x, y = panel.corners.mean(axis=0).tolist()
    length = float(np.linalg.norm(panel.corners[1] - panel.corners[0], axis=-1))
    yaw = math.atan2(door.axes[0, 1], door.axes[0, 0])
    size = (length / 2, THICKNESS_M / 2, top / 2)
    return Geom("box", size, (x, y, top / 2), about_z(yaw), _MATERIAL)
