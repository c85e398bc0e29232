"""Fixed furniture that stands on receptacles: cups, plates and cushions that belong to a home, not to an episode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from mjhab.core.rotations import mat_from_quat
from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import PlacedReceptacle, placed_receptacles
from mjhab.scenes.shapes.footprints import meet, outline
from mjhab.scenes.spec import Home, Pack, Placement

BELOW_M = 0.06
"""A thing stands on a receptacle if its lowest point is at most this far below the surface [m]: it may sink in."""
ABOVE_M = 0.12
"""The same above the surface [m]: things on a tray, or hanging so low that nothing goes below."""
Outlines = tuple[np.ndarray, ...]
"""Convex polygons (N, 2) [m] in the world, seen from above, counter-clockwise."""


@dataclass(frozen=True, eq=False)
class _Thing:
    slot: str
    bottom: float
    template: str
    placement: Placement


def standing_on(layout: Layout, home: Home) -> dict[str, Outlines]:
    """Return the outlines of the props that stand on each receptacle of a home, by the receptacle's id.

    Receptacles on which nothing stands are absent. A prop does not stand on its own receptacles. The result is cached
    in the layout.
    """
    return layout.derived.get(("standing", home.name), lambda: _standing_on(layout, home))


def clear_of(outlines: Outlines, pos: np.ndarray, radius: float) -> bool:
    """Return whether a circle of ``radius`` [m] about ``pos`` (2,) or (3,) [m] meets none of the outlines."""
    return all(_distance(outline, pos[:2]) > radius for outline in outlines)


def _standing_on(layout: Layout, home: Home) -> dict[str, Outlines]:
    things = _things(layout, home)
    bottoms = np.array([thing.bottom for thing in things])
    drawn: dict[int, list[np.ndarray]] = {}
    found: dict[str, Outlines] = {}
    for place in placed_receptacles(layout, home):
        # Heights first, for all things at once: most are out of question.
        lift = bottoms - place.pos[2]
        near = np.flatnonzero((lift >= -BELOW_M) & (lift <= ABOVE_M)).tolist()
        outlines: list[np.ndarray] = []
        for k in near:
            if place.id.startswith(things[k].slot + "/"):
                continue
            # A thing may be near several receptacles.
            if k not in drawn:
                drawn[k] = _outlines(things[k], layout.pack)
            outlines += [p for p in drawn[k] if _reaches(p, _corners(place))]
        if outlines:
            found[place.id] = tuple(outlines)
    return found


def _reaches(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two convex polygons (N, 2), (M, 2) overlap; most are told apart by their bounds."""
    apart = (a.min(0) > b.max(0)) | (b.min(0) > a.max(0))
    return not apart.any() and meet(a, b)


def _things(layout: Layout, home: Home) -> list[_Thing]:
    """The props of a home that collide, with the height of their lowest points."""
    slots = zip(layout.prop_slots, layout.slot_placements(home), strict=True)
    return [
        _Thing(slot.name, bottom, slot.template, placement)
        for slot, placement in slots
        if placement is not None
        and (bottom := _bottom(layout, slot.template, placement)) is not None
    ]


def _bottom(layout: Layout, template: str, at: Placement) -> float | None:
    # A turn about the vertical does not change the lowest point, so that most copies share one.
    turned = None if at.quat is None else at.rotation
    low = layout.pack.derived.get(
        ("bottom", template, turned),
        lambda: (_lowest(layout.pack, template, turned),),
        # A tuple, since a cache cannot hold None.
    )[0]
    return None if low is None else low + at.pos[2]


def _lowest(
    pack: Pack, template: str, turned: tuple[float, float, float, float] | None
) -> float | None:
    """Lowest point [m] of a prop over the origin of its template, None if it does not collide."""
    placement = Placement(template, (0.0, 0.0, 0.0), quat=turned)
    points = _points(pack, template, placement)
    return min(float(p[:, 2].min()) for p in points) if points else None


def _points(pack: Pack, template: str, at: Placement) -> list[np.ndarray]:
    """Points (P, 3) [m] in the world around which the hull of each colliding geom of a placed prop lies."""
    turn = mat_from_quat(np.array(at.rotation))
    return [
        outline(geom, pack.meshes) @ turn.T + np.array(at.pos)
        for geom in pack.props[template].geoms
        if geom.collide
    ]


def _outlines(thing: _Thing, pack: Pack) -> list[np.ndarray]:
    # To nanometres, so that points that differ by rounding are one.
    flat = [p[:, :2].round(9) for p in _points(pack, thing.template, thing.placement)]
    # Points above each other are one in the plane.
    unique = [np.unique(points, axis=0) for points in flat]
    return [points[ConvexHull(points).vertices] for points in unique]


def _corners(place: PlacedReceptacle) -> np.ndarray:
    x, y = place.half
    return np.stack(
        [place.point(u, v)[:2] for u, v in ((-x, -y), (x, -y), (x, y), (-x, y))]
    )


def _distance(polygon: np.ndarray, xy: np.ndarray) -> float:
    """Distance [m] of a point (2,) from a convex polygon (N, 2), counter-clockwise; 0 inside."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    away = xy - polygon
    if np.all(edges[:, 0] * away[:, 1] - edges[:, 1] * away[:, 0] >= 0.0):
        return 0.0
    along = np.clip((edges * away).sum(1) / (edges**2).sum(1), 0.0, 1.0)
    return float(np.linalg.norm(away - along[:, None] * edges, axis=1).min())
