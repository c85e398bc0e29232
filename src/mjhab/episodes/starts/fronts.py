"""Floor areas in front of drawers and doors, in which a robot opens and closes them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mjhab.layout.layout import Layout
from mjhab.scenes.spec import FrontArea, Home, Vec3
from mjhab.tasks.plan import Box

DRAWER_AREA = FrontArea(near_m=0.3, far_m=1.5, half_width_m=0.6)
"""Area relative to the origin of the closed drawer's link (mshab/utils/gen/gen_spawn_positions.py)."""
DOOR_AREA = FrontArea(near_m=0.53, far_m=1.43, half_width_m=0.6)
"""Area relative to the handle of the closed door, for furniture without an area of its own. It equals MS-HAB's area in
front of the fridge (`FRIDGE_FRONT_AREA`) relative to the handle of the built-in fridge."""


@dataclass(frozen=True)
class LinkFront:
    """The front of a drawer or door: floor ``area`` from ``root`` (x, y) [m] on along ``yaw`` [rad], world frame."""

    root: tuple[float, float]
    yaw: float
    area: FrontArea

    @property
    def box(self) -> Box:
        """Bounding box of the area along the world axes: x_min, x_max, y_min, y_max [m]."""
        cos = math.cos(self.yaw)
        sin = math.sin(self.yaw)
        half = self.area.half_width_m
        # Furniture may stand at any angle, while success is tested along the axes of the world.
        corners = [
            (x, y) for x in (self.area.near_m, self.area.far_m) for y in (-half, half)
        ]
        xs = [self.root[0] + cos * x - sin * y for x, y in corners]
        ys = [self.root[1] + sin * x + cos * y for x, y in corners]
        return (min(xs), max(xs), min(ys), max(ys))


def link_front(layout: Layout, home: Home, link_id: str) -> LinkFront:
    """Return the front of a link in a home, in the direction in which its handle points.

    Furniture with an area (`Articulation.front_area`) has it for all its links, relative to its own origin. Other
    drawers have `DRAWER_AREA`, other doors `DOOR_AREA`.

    Args:
        layout: layout of the home.
        home: the home.
        link_id: id of the link, e.g. "kitchen_counter/drawer3".
    """
    ref = layout.links[layout.link_ids.index(link_id)]
    placement = layout.articulation_placement(home, ref.articulation)
    out = ref.link.handle.out
    # A template may have its front along any of its axes.
    yaw = placement.yaw + math.atan2(out[1], out[0])
    own = layout.pack.articulations[ref.articulation].front_area
    if own is not None:
        return LinkFront(_xy(placement.pos), yaw, own)
    if ref.link.joint == "slide":
        return LinkFront(_xy(layout.closed_link_origin(home, link_id)), yaw, DRAWER_AREA)
    return LinkFront(_xy(layout.closed_handle(home, link_id)), yaw, DOOR_AREA)


def _xy(point: Vec3) -> tuple[float, float]:
    return (point[0], point[1])
