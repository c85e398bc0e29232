"""Path planners of a home, with its doors and drawers closed or as they are.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import numpy as np

from mjhab.core.boxes import nearest_box_distance
from mjhab.envs.parts.world_view import HomeShapes, WorldView
from mjhab.experts.arm.clearance import Boxes
from mjhab.experts.base.navigation import FloorClearance, Planner

OVERHANG_M = 0.05
"""Added to the clearance to open drawers and doors: at their height the robot is narrower than at its base."""


def planner(view: WorldView, *, shut: bool = False) -> Planner:
    """Path planner of the world's home, with the doors and drawers that are open now as obstacles.

    Args:
        view: the world.
        shut: count all doors and drawers as closed.
    """
    home = view.home
    # Rounded, so that a door that swings a little does not ask for a new map in every step.
    ajar = () if shut else tuple((k, round(view.link_q(k), 1)) for k in home.links)
    # What is shut is part of the furniture already.
    ajar_now = tuple((name, q) for name, q in ajar if q > 0.05)
    if not ajar_now:
        return home.derived.get("planner", lambda: _planner(home))
    return home.derived.get(("planner", ajar_now), lambda: _planner_with(home, ajar_now))


def _planner(home: HomeShapes) -> Planner:
    # Time limits are short: little comfort clearance gives short paths.
    return Planner(
        FloorClearance(home.map_origin, home.map_cell, home.map_clearance),
        radius=home.robot.footprint.wide,
        comfort=0.12,
        caution=2.0,
        narrow=home.robot.footprint.narrow,
    )


def _planner_with(home: HomeShapes, ajar: tuple[tuple[str, float], ...]) -> Planner:
    plain = home.derived.get("planner", lambda: _planner(home))
    boxes = Boxes.join([home.links[name].boxes(q) for name, q in ajar])
    centres = plain.grid.centres
    cells = np.concatenate([centres, np.zeros((*centres.shape[:2], 1))], axis=2)
    # Doors and drawers are upright: distances in the horizontal plane suffice.
    flat = Boxes(boxes.center * [1.0, 1.0, 0.0], boxes.half, boxes.rot)
    gap = (
        nearest_box_distance(cells.reshape(-1, 3), flat).reshape(centres.shape[:2])
        + OVERHANG_M
    )
    # Never below 0, as in the map.
    clearance = np.minimum(plain.clearance, np.maximum(gap, 0.0))
    return Planner(
        FloorClearance(plain.origin, plain.cell, clearance),
        plain.radius,
        plain.comfort,
        plain.caution,
        plain.narrow,
    )
