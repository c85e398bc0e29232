"""Ways in which a parallel gripper closes on a box, a can, a ball or a bowl: where the pads meet it, from where.

Gripper frame as in `grasps`. Lengths [m], world frame. Letters: A directions of approach, P points of contact.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from mjhab.core.errors import unknown_name
from mjhab.robots.parts import Gripper
from mjhab.scenes.builtin.objects import BOWL_FACETS

Array = np.ndarray
CORNER_YAWS = (-0.1, 0.0, 0.1)
CORNER_TILTS = (0.0, 0.26, 0.44, 0.6)
"""Angles [rad] between the hand and the diagonal of a corner that it holds, and of the hand down from level. Faces
lean from the line on which the pads close by 45 degrees and the former: less than the angle of their friction, 56."""
CORNER_PLAY = 0.003
CORNER_LEAST = 0.036
CORNER_HEIGHT = 0.018
CORNER_GAP = 0.003
"""Room left on both sides by fingers around a corner, how deep they get and how much of its edge they cover at least
(else it slips out when the hand moves), and room between it and the palm."""
CHORD_PLAY = 0.0015
"""Room [m] left on both sides by pads that come down around a chord of a can too wide to go around."""
UPRIGHT = 0.97
"""Least cosine between an edge and the vertical."""


@dataclass(frozen=True)
class ObjectShape:
    """What is to be grasped. ``half``: half-extents of its bounding box, cylinders and bowls stand along z.

    Bowls: ``wall`` thickness and ``lean``, the angle [rad] between the wall at the rim and the axis; ``facets``: flat
    pieces the collision wall is made of, the first centred on +x (0: round); pads fit them best in their middles.
    """

    kind: Literal["box", "cylinder", "sphere", "bowl"]
    half: tuple[float, float, float]
    wall: float = 0.0045
    lean: float = 0.197
    facets: int = BOWL_FACETS


@dataclass(frozen=True)
class Options:
    """``floor_gap``: room kept between gripper and support, ``palm_gap`` between palm and object; ``retreat``: how far
    back the pre-grasp lies; ``spread``: room added to the opening while approaching; ``fan``: directions tried around
    each closing line; ``shallower``: how much less deep than possible [m] the hand may come; ``leans``: of the hand
    outwards over a bowl's rim, from along its wall [rad]; ``inward``: (2,) level direction into a shelf, the hand does
    not come against it; ``cells``: points looked at along a side of a box; ``scant``: price in points per metre that
    the root of the area on which pads hold flat sides lacks to 2 cm; ``corners``: hold boxes by two sides around a
    corner, too; ``preference``: points for a `grasps.KINDS` of approach."""

    floor_gap: float = 0.006
    palm_gap: float = 0.005
    retreat: float = 0.10
    spread: float = 0.036
    fan: int = 24
    shallower: tuple[float, ...] = (0.0,)
    leans: tuple[float, ...] = (0.0, 0.2, -0.2, 0.4)
    inward: tuple[float, float] | None = None
    cells: int = 15
    scant: float = 0.0
    corners: bool = False
    preference: dict[str, float] = field(
        default_factory=lambda: {"top": 1.0, "tilted": 0.8, "side": 0.5}
    )


@dataclass(frozen=True, eq=False)
class Hold:
    """A way of closing: pads meet the object on ``locus`` (P, 3) when closing along ``closing`` (3,), coming along one
    of ``approach`` (A, 3). ``at`` (A, 3): the tool centre; None: as deep as palm and floor allow."""

    closing: Array
    approach: Array
    locus: Array
    width: float
    at: Array | None = None
    bonus: float = 0.0
    least: float = 0.010
    """Wanted length of the locus (or root of its area) within the pads."""
    measure: float = 0.0
    """Length (or root of the area) of the whole locus; 0 for a point."""
    planar: bool = False
    """The locus samples an area, not a line."""

    @property
    def point(self) -> bool:
        """The pads meet the object in one point each."""
        return len(self.locus) == 1


def holds_of(
    shape: ObjectShape, pos: Array, rot: Array, gripper: Gripper, options: Options
) -> Iterator[Hold]:
    """Ways to close on a shape at ``pos`` (3,), ``rot`` (3, 3).

    Raises:
        UsageError: unknown kind of shape.
    """
    makers = {
        "box": _box_holds,
        "cylinder": _cylinder_holds,
        "sphere": _sphere_holds,
        "bowl": _bowl_holds,
    }
    if shape.kind not in makers:
        raise unknown_name("object shape", shape.kind, makers)
    return makers[shape.kind](shape, pos, rot, gripper, options)


def _box_holds(
    shape: ObjectShape, pos: Array, rot: Array, gripper: Gripper, options: Options
) -> Iterator[Hold]:
    for i in range(3):
        width = 2 * shape.half[i]
        if width > gripper.usable:
            continue
        j = (i + 1) % 3
        k = (i + 2) % 3
        cells = np.linspace(-1, 1, options.cells)
        u, v = np.meshgrid(cells * shape.half[j], cells * shape.half[k])
        face = pos + u.reshape(-1, 1) * rot[:, j] + v.reshape(-1, 1) * rot[:, k]
        size = 2 * np.sqrt(shape.half[j] * shape.half[k])
        fan = _fan(rot[:, i], rot[:, j], options.fan)
        yield Hold(rot[:, i], fan, face, width, least=0.014, measure=size, planar=True)
    if options.corners:
        for k in np.flatnonzero(np.abs(rot[2]) > UPRIGHT):
            yield from _corner_holds(shape, pos, rot, int(k), gripper)


def _corner_holds(
    shape: ObjectShape, pos: Array, rot: Array, k: int, gripper: Gripper
) -> Iterator[Hold]:
    """A box by two sides that meet in an upright edge, axis ``k``: the hand comes along about their diagonal.

    The fingertips get as far beyond the edge as the open hand lets them; friction holds, see `CORNER_YAWS`.
    """
    i = (k + 1) % 3
    j = (k + 2) % 3
    up = rot[:, k] * np.sign(rot[2, k])
    full = gripper.opening - 2 * CORNER_PLAY
    for si, sj, yaw in itertools.product((-1.0, 1.0), (-1.0, 1.0), CORNER_YAWS):
        first = si * rot[:, i]
        second = sj * rot[:, j]
        angle = np.pi / 4 + yaw
        spread = np.tan(angle) + 1.0 / np.tan(angle)
        ends = 0.97 * 2.0 * min(shape.half[j] * np.sin(angle), shape.half[i] * np.cos(angle))
        depth = min(full / spread, ends)
        if depth < CORNER_LEAST:
            continue
        level = -np.cos(angle) * first - np.sin(angle) * second
        closing = np.sin(angle) * first - np.cos(angle) * second
        aside = 0.5 * depth * (1.0 / np.tan(angle) - np.tan(angle))
        edge = pos + shape.half[i] * first + shape.half[j] * second + aside * closing
        bonus = -0.8 - 20.0 * (full / spread - depth)
        for tilt in CORNER_TILTS:
            at, line = _around_edge(edge, level, up, shape.half[k], depth, tilt, gripper)
            approach = np.tile(np.cos(tilt) * level - np.sin(tilt) * up, (len(at), 1))
            yield Hold(
                closing,
                approach,
                line,
                depth * spread,
                at,
                bonus,
                CORNER_HEIGHT,
                measure=2 * shape.half[k],
            )


def _around_edge(
    edge: Array, level: Array, up: Array, half: float, depth: float, tilt: float, gripper: Gripper
) -> tuple[Array, Array]:
    """Tool centres (A, 3) at several heights from which the tips of a hand tilted down get ``depth`` beyond an edge of
    height 2 ``half`` around ``edge`` (3,), and where about they meet the sides, (81, 3) in the middle between them."""
    c = np.cos(tilt)
    s = np.sin(tilt)
    (tip, across) = gripper.finger
    heights = np.linspace(-1.0, 1.0, 9) * half + tip * s
    back = depth - tip * c - across * s
    # How far up the front of the palm comes to the edge: there the box must have ended.
    meets = (-back - CORNER_GAP - gripper.palm_x[1] * c) / max(s, 1e-9)
    if meets < gripper.palm_half[1]:
        heights = heights[heights - gripper.palm_x[1] * s + meets * c > half + CORNER_GAP]
    line = (
        edge + (depth - 2 * across * s - 0.001) * level + np.linspace(-half, half, 81)[:, None] * up
    )
    return edge + back * level + heights[:, None] * up, line


def _cylinder_holds(
    shape: ObjectShape, pos: Array, rot: Array, gripper: Gripper, options: Options
) -> Iterator[Hold]:
    radius = shape.half[0]
    half = shape.half[2]
    axis = rot[:, 2]
    line = pos + np.linspace(-half, half, 81)[:, None] * axis
    for angle in np.arange(12) * np.pi / 12:
        closing = np.cos(angle) * rot[:, 0] + np.sin(angle) * rot[:, 1]
        if 2 * radius <= gripper.usable:
            yield Hold(
                closing, _fan(closing, axis, options.fan), line, 2 * radius, measure=2 * half
            )
        else:
            yield from _chord_holds(radius, half, pos, axis, closing, line, gripper)
            yield from _tip_holds(radius, half, pos, axis, closing, line, gripper)
    if 2 * half <= gripper.usable:
        u, v = np.meshgrid(np.linspace(-1, 1, 15) * radius, np.linspace(-1, 1, 15) * radius)
        disk = np.stack([u.ravel(), v.ravel()], axis=1)
        disk = disk[np.linalg.norm(disk, axis=1) <= radius] @ rot[:, :2].T + pos
        size = np.sqrt(np.pi) * radius
        yield Hold(
            axis,
            _fan(axis, rot[:, 0], options.fan),
            disk,
            2 * half,
            least=0.014,
            measure=size,
            planar=True,
        )


def _chord_holds(
    radius: float,
    half: float,
    pos: Array,
    axis: Array,
    closing: Array,
    line: Array,
    gripper: Gripper,
) -> Iterator[Hold]:
    """A can too wide to go around: coming along its axis, the pads' edges meet it on a chord beside the axis.

    The normals lean from the closing line by asin(offset / radius), 21 degrees for the widest can of the benchmark;
    the pads' friction (coefficient above tan of that) holds it. The grasp test allows 30 degrees, and as the can slips
    along the pads its normals lean more: the chord is as wide as the hand opens but for CHORD_PLAY.
    """
    width = gripper.opening - 2 * CHORD_PLAY
    if width / 2 >= radius or radius - width / 2 > 0.012:
        return
    offset = float(np.sqrt(radius**2 - (width / 2) ** 2))
    across = np.cross(axis, closing)
    for side in (-1.0, 1.0):
        chord = line + side * offset * across
        for down in (-axis, axis):
            deep = min(half, gripper.finger[0] + 0.027)
            at = (
                pos
                - down * (half - deep + gripper.finger[0])
                + side * (offset + gripper.finger[1]) * across
            )
            yield Hold(closing, down[None], chord, width, at[None], bonus=-0.4, measure=2 * half)


def _tip_holds(
    radius: float,
    half: float,
    pos: Array,
    axis: Array,
    closing: Array,
    line: Array,
    gripper: Gripper,
) -> Iterator[Hold]:
    """A can a little too wide to go around: coming from the side, the round edges of the fingertips hold it on a chord
    before the axis, as far back as the open hand gets. The more the tips miss the axis, the sooner it is lost."""
    width = gripper.opening - 2 * gripper.play
    if not 0.0 < radius - width / 2 < 0.004:
        return
    offset = float(np.sqrt(radius**2 - (width / 2) ** 2))
    tip = gripper.finger[0]
    heights = np.linspace(-1.0, 1.0, 7)[:, None] * max(half - gripper.finger[1], 0.0) * axis
    for side in (-1.0, 1.0):
        approach = side * np.cross(axis, closing)
        at = pos + heights - (offset + tip) * approach
        chord = line - (offset + 1e-4) * approach
        yield Hold(
            closing, np.tile(approach, (len(at), 1)), chord, width, at, bonus=-0.6, measure=2 * half
        )


def _sphere_holds(
    shape: ObjectShape, pos: Array, rot: Array, gripper: Gripper, options: Options
) -> Iterator[Hold]:
    width = 2 * max(shape.half)
    if width > gripper.usable:
        return
    for angle in np.arange(8) * np.pi / 8:
        closing = np.array([np.cos(angle), np.sin(angle), 0.0])
        yield Hold(closing, _fan(closing, np.array([0.0, 0.0, 1.0]), options.fan), pos[None], width)


def _bowl_holds(
    shape: ObjectShape, pos: Array, rot: Array, gripper: Gripper, options: Options
) -> Iterator[Hold]:
    """One finger inside, one outside the wall, both about parallel to it; several leans of the hand at every place."""
    axis = rot[:, 2]
    half = shape.half[2]
    count = shape.facets or BOWL_FACETS
    # The middle of a flat facet lies nearer to the axis than its corners.
    radius = (shape.half[0] - shape.wall / 2) * (np.cos(np.pi / count) if shape.facets else 1.0)
    for angle in np.arange(count) * 2 * np.pi / count:
        out = np.cos(angle) * rot[:, 0] + np.sin(angle) * rot[:, 1]
        rim = pos + half * axis + radius * out
        for extra in options.leans:
            lean = shape.lean + extra
            down = -np.cos(lean) * axis - np.sin(lean) * out
            closing = np.cos(lean) * out - np.sin(lean) * axis
            wall = rim + np.linspace(0.0, 0.03, 16)[:, None] * down
            # The more the hand leans, the sooner the tip outside meets the wall below the rim.
            at = rim[None] + (0.002 - 0.02 * max(extra - 0.4, 0.0)) * down
            yield Hold(closing, down[None], wall, shape.wall, at, bonus=-abs(extra), measure=0.03)


def _fan(closing: Array, start: Array, count: int) -> Array:
    """Approach directions (A, 3) around a closing axis, without those that come from below."""
    u = start - closing * (start @ closing)
    u = u / np.linalg.norm(u)
    angle = np.arange(count) * 2 * np.pi / count
    fan = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * np.cross(closing, u)
    return fan[fan[:, 2] <= 0.05]
