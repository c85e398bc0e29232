"""Receptacles of a home in world coordinates."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mjhab.layout.layout import Layout, compose
from mjhab.scenes.roles import plays
from mjhab.scenes.spec import Home, Placement, Receptacle, Roles, Vec3


@dataclass(frozen=True)
class PlacedReceptacle:
    """A receptacle of a home, with all joints closed. ``id`` is ``<thing>/<receptacle>``.

    ``template`` is the prop or articulation it belongs to, of whose receptacles it is number ``rank``; ``link`` the
    moving link id that carries it, or "".
    ``pos`` the world centre of its supporting rectangle, ``yaw`` its heading, ``half`` its half-extents [m].
    """

    id: str
    name: str
    template: str
    kind: str
    link: str
    pos: Vec3
    yaw: float
    half: tuple[float, float]
    height: float
    rank: int = 0

    def point(self, u: float, v: float) -> np.ndarray:
        """World position (3,) of the point at (u, v) [m] from the centre in the receptacle's own axes."""
        c = np.cos(self.yaw)
        s = np.sin(self.yaw)
        return np.array([self.pos[0] + c * u - s * v, self.pos[1] + s * u + c * v, self.pos[2]])

    def holds(self, x: float, y: float) -> bool:
        """Whether a world point [m] lies within the supporting rectangle as seen from above."""
        c = math.cos(self.yaw)
        s = math.sin(self.yaw)
        dx = x - self.pos[0]
        dy = y - self.pos[1]
        return abs(c * dx + s * dy) <= self.half[0] and abs(c * dy - s * dx) <= self.half[1]

    def local(self, xy: np.ndarray) -> np.ndarray:
        """Coordinates (..., 2) of world points (..., 2) in the receptacle's own axes."""
        d = np.asarray(xy) - np.asarray(self.pos[:2])
        c = np.cos(self.yaw)
        s = np.sin(self.yaw)
        return np.stack([c * d[..., 0] + s * d[..., 1], -s * d[..., 0] + c * d[..., 1]], axis=-1)


def placed_receptacles(layout: Layout, home: Home) -> tuple[PlacedReceptacle, ...]:
    """Every receptacle of a home, in the order of the layout's slots."""
    out: list[PlacedReceptacle] = []
    for slot, placement in zip(layout.prop_slots, layout.slot_placements(home), strict=True):
        if placement is not None:
            prop = layout.pack.props[slot.template]
            out += [
                _place(slot.name, slot.template, k, r, placement, (0.0, 0.0, 0.0))
                for k, r in enumerate(prop.receptacles)
            ]
    for articulation in layout.articulations:
        placement = layout.articulation_placement(home, articulation.name)
        if placement not in home.articulations:
            continue
        origin = {link.name: link.pos for link in articulation.links}
        for k, r in enumerate(articulation.receptacles):
            out.append(
                _place(
                    articulation.name,
                    articulation.name,
                    k,
                    r,
                    placement,
                    origin.get(r.link, (0.0, 0.0, 0.0)),
                )
            )
    return tuple(out)


def with_role(
    receptacles: Iterable[PlacedReceptacle], roles: Roles, *names: str
) -> list[PlacedReceptacle]:
    """The receptacles that play one of the roles ``names``, in the given order."""
    return [
        r
        for r in receptacles
        if any(plays(roles, name, r.template, r.name, first=r.rank == 0) for name in names)
    ]


def link_to_open(place: PlacedReceptacle, roles: Roles) -> str:
    """Id of the link that must be open to reach into a receptacle, or ""."""
    return place.link or roles.closed_by.get(f"{place.template}/{place.name}", "")


def _place(
    thing: str, template: str, rank: int, r: Receptacle, at: Placement, origin: Vec3
) -> PlacedReceptacle:
    local = (origin[0] + r.pos[0], origin[1] + r.pos[1], origin[2] + r.pos[2])
    pos, _ = compose(at.pos, at.rotation, local)
    link = f"{thing}/{r.link}" if r.link else ""
    return PlacedReceptacle(
        f"{thing}/{r.name}", r.name, template, r.kind, link, pos, at.yaw, r.half, r.height, rank
    )
