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
    """A receptacle of a home in the world frame, with all joints closed. Its support is a level rectangle.

    Attributes:
        id: ``<thing>/<receptacle>``, where the thing is a prop slot or an articulation.
        name: name of the receptacle in its template.
        template: name of the prop or articulation that it belongs to.
        kind: "open" (free surface), "drawer" or "shelf".
        link: id of the moving link that carries it, "" if none does.
        pos: centre of the rectangle, world frame [m].
        yaw: heading of the rectangle's x axis, world frame [rad].
        half: half-extents of the rectangle along its own x and y [m].
        height: free height above the rectangle [m].
        rank: index among the receptacles of the template.
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
        """Return the world position (3,) [m] of the point at (u, v) [m] from the centre along the rectangle's axes."""
        c = np.cos(self.yaw)
        s = np.sin(self.yaw)
        return np.array(
            [self.pos[0] + c * u - s * v, self.pos[1] + s * u + c * v, self.pos[2]]
        )

    def holds(self, x: float, y: float) -> bool:
        """Return whether the world point (x, y) [m] lies within the rectangle seen from above."""
        c = math.cos(self.yaw)
        s = math.sin(self.yaw)
        dx = x - self.pos[0]
        dy = y - self.pos[1]
        return (
            abs(c * dx + s * dy) <= self.half[0] and abs(c * dy - s * dx) <= self.half[1]
        )

    def local(self, xy: np.ndarray) -> np.ndarray:
        """Return coordinates (..., 2) [m] along the rectangle's axes of world points (..., 2) [m]."""
        d = np.asarray(xy) - np.asarray(self.pos[:2])
        c = np.cos(self.yaw)
        s = np.sin(self.yaw)
        return np.stack(
            [c * d[..., 0] + s * d[..., 1], -s * d[..., 0] + c * d[..., 1]], axis=-1
        )


def placed_receptacles(layout: Layout, home: Home) -> tuple[PlacedReceptacle, ...]:
    """Return every receptacle of a home, in the order of the layout's prop slots, then articulations."""
    out: list[PlacedReceptacle] = []
    for slot, placement in zip(
        layout.prop_slots, layout.slot_placements(home), strict=True
    ):
        if placement is not None:
            prop = layout.pack.props[slot.template]
            out += [
                _place(slot.name, slot.template, k, r, placement, (0.0, 0.0, 0.0))
                for k, r in enumerate(prop.receptacles)
            ]
    for articulation in layout.articulations:
        placement = layout.articulation_placement(home, articulation.name)
        # Parked below the floor: the home lacks it.
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
    """Return the receptacles that have one of the roles ``names``, in the order of ``receptacles``."""
    return [
        r
        for r in receptacles
        if any(
            plays(roles, name, r.template, r.name, first=r.rank == 0) for name in names
        )
    ]


def link_to_open(place: PlacedReceptacle, roles: Roles) -> str:
    """Return the id of the link that must be open to reach into a receptacle, "" if there is none."""
    return place.link or roles.closed_by.get(f"{place.template}/{place.name}", "")


def _place(
    thing: str, template: str, rank: int, r: Receptacle, at: Placement, origin: Vec3
) -> PlacedReceptacle:
    local = (origin[0] + r.pos[0], origin[1] + r.pos[1], origin[2] + r.pos[2])
    pos, _ = compose(at.pos, at.rotation, local)
    link = f"{thing}/{r.link}" if r.link else ""
    return PlacedReceptacle(
        f"{thing}/{r.name}",
        r.name,
        template,
        r.kind,
        link,
        pos,
        at.yaw,
        r.half,
        r.height,
        rank,
    )
