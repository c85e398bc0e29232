"""What blocks the base of a robot: colliding geoms between the floor and the height of the robot, seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjhab.core.rotations import mat_from_quat
from mjhab.scenes.shapes.footprints import all_geoms, outline, turned
from mjhab.scenes.shapes.hulls import hull_from_above
from mjhab.scenes.spec import (
    IDENTITY,
    Articulation,
    Geom,
    Home,
    Pack,
    Placement,
    Prop,
)

ROBOT_HEIGHT_M = 1.4
"""Geoms entirely above this height [m] do not block the base; the head camera of the benchmark's robot is at 1.41 m."""
_AT_ORIGIN = Placement("wall", (0.0, 0.0, 0.0))
"""Walls are in the world."""
_AROUND = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
"""Signs of the corners of a box seen from above, counter-clockwise."""


def blocking_polygons(home: Home, pack: Pack) -> list[np.ndarray]:
    """Compute the convex polygons (N, 2) [m] in the world, counter-clockwise, of all geoms that block the base."""
    # Homes of one floor plan have most walls and much furniture at the same places.
    kept = pack.derived
    polygons: list[np.ndarray] = []
    for wall in home.walls:
        polygons += kept.get(
            ("blocking", wall),
            lambda wall=wall: _Template.of([wall], pack).polygons(_AT_ORIGIN),
        )
    for placement in (*home.props, *home.articulations):
        template = (
            pack.props.get(placement.template) or pack.articulations[placement.template]
        )
        # Rugs lie under the robot.
        if isinstance(template, Prop) and not template.blocks_base:
            continue
        polygons += kept.get(
            ("blocking", placement),
            lambda template=template, placement=placement: _template(
                template, pack
            ).polygons(placement),
        )
    return polygons


def _template(template: Prop | Articulation, pack: Pack) -> _Template:
    """The shapes of a template, cached in the pack, because the same ones stand in all homes."""
    return pack.derived.get(
        ("blocking", template.name), lambda: _Template.of(all_geoms(template), pack)
    )


@dataclass(frozen=True, eq=False)
class _Template:
    """Colliding geoms of a template, in its frame [m].

    Attributes:
        plain: (K, 4, 2) corners, seen from above, of boxes whose edges are parallel to its axes: most geoms.
        plain_z: (K, 2) their lowest and highest points.
        others: points (P, 3) around each other geom.
        every: the same of all geoms.
    """

    plain: np.ndarray
    plain_z: np.ndarray
    others: list[np.ndarray]
    every: list[np.ndarray]

    @staticmethod
    def of(geoms: Sequence[Geom], pack: Pack) -> _Template:
        solid = [g for g in geoms if g.collide]
        # Boxes along the axes are most of a home, and need no hull.
        plain = [g.shape == "box" and g.quat == IDENTITY for g in solid]
        boxes = [g for g, is_plain in zip(solid, plain, strict=True) if is_plain]
        pos = np.array([g.pos for g in boxes]).reshape(-1, 3)
        half = np.array([g.size for g in boxes]).reshape(-1, 3)
        corners = pos[:, None, :2] + half[:, None, :2] * _AROUND
        z = np.stack([pos[:, 2] - half[:, 2], pos[:, 2] + half[:, 2]], axis=1)
        every = [outline(g, pack.meshes) for g in solid]
        others = [p for p, is_plain in zip(every, plain, strict=True) if not is_plain]
        return _Template(corners, z, others, every)

    def polygons(self, placement: Placement) -> list[np.ndarray]:
        """Those (N, 2) [m] of the placed geoms that block the base, in the world, counter-clockwise."""
        lift = placement.pos[2]
        if placement.quat is None:
            low, high = (self.plain_z + lift).T
            seen = (low < ROBOT_HEIGHT_M) & (high > 0.0)
            found = list(turned(placement, self.plain[seen]))
            rest = self.others
        else:
            found = []
            rest = self.every
        if not rest:
            return found
        turn = mat_from_quat(np.array(placement.rotation)).T
        return found + [
            hull
            for points in rest
            if (hull := _flat_hull(points @ turn + np.array(placement.pos))) is not None
        ]


def _flat_hull(points: np.ndarray) -> np.ndarray | None:
    """Counter-clockwise hull (N, 2) [m] of points (P, 3) seen from above; None if it does not block the base."""
    if points[:, 2].min() >= ROBOT_HEIGHT_M or points[:, 2].max() <= 0.0:
        return None
    return hull_from_above(points)
