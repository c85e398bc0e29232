"""Pinches: lines on which the two pads of a parallel gripper close on an object, with directions of approach.

Gripper frame as in `candidates`. Lengths [m], world frame. Letters: A directions of approach, P points of contact.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from mjhab.core.errors import UsageError, unknown_name
from mjhab.robots.parts import Gripper
from mjhab.scenes.builtin.objects import BOWL_FACETS

Array = np.ndarray
CHORD_PLAY_M = 0.0015
"""Gap between each pad of the open gripper and the chord on which it grasps a can wider than its opening."""
MAX_APPROACH_RISE = 0.05
"""Largest z component of a unit direction of approach, which excludes approaches from below."""
FULL_PATCH_M = 0.025
"""Square root of the contact area of the pads above which more area does not increase a mesh grasp's score."""
PATCH_BONUS_PER_M = 40.0
"""Score of a mesh grasp per metre of the square root of the pads' contact area."""
SLANT_COST_PER_RAD = 4.0
"""Score that a mesh grasp loses per radian between its closing line and the surface normals."""


MIN_UPRIGHT_COSINE = 0.97
"""Least cosine between an axis of a box and the vertical for slanted grasps."""
SLANT_EDGE_M = 0.014
"""Least distance of the edge of a box from the fingertips in a slanted grasp."""
SLANT_DEPTH_M = 0.04
"""Least depth of the box between the fingers in a slanted grasp."""
SLANT_PLAY_M = 0.004
"""Least gap between either finger and the box on the approach to a slanted grasp."""
SLANT_FALLS = (0.0, 0.17, 0.34, 0.5)
"""Sines of the angles by which the hand points down in slanted grasps."""
SLANT_HEIGHTS = (-1.0, -0.5, 0.0, 0.5, 0.9)
"""Heights of slanted grasps as fractions of half the height of the box."""
SLANT_BASE_COST = 0.3
"""Score that a slanted grasp loses."""
SLANT_BOX_COST_PER_RAD = 2.0
"""Score that it loses per radian of its slant."""


@dataclass(frozen=True, eq=False)
class SurfaceGrasps:
    """M grasps in the frame of the object.

    Attributes:
        pos: (M, 3) position of the tcp.
        approach: (M, 3) unit direction along the fingers.
        closing: (M, 3) unit direction of the line on which the pads close.
        contact: (M, 3) midpoint of the two contacts.
        width: (M,) distance between the contacts.
        most_open: (M,) widest opening for a collision-free approach.
        slant: (M,) larger angle [rad] between the closing line and the surface normal at a contact.
        patch: (M,) square root of the contact area of the pad that has less.
    """

    pos: Array
    approach: Array
    closing: Array
    contact: Array
    width: Array
    most_open: Array
    slant: Array
    patch: Array

    def __len__(self) -> int:
        return len(self.pos)

    def take(self, rows: Array) -> SurfaceGrasps:
        """Return the grasps of row indices or a mask."""
        return SurfaceGrasps(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class ObjectShape:
    """Shape of an object to grasp. The axis of cylinders and bowls is z.

    Attributes:
        kind: type of the shape.
        half: half-extents of its bounding box.
        wall: bowls: thickness of the wall.
        lean: bowls: angle [rad] between the wall at the rim and the axis.
        facets: bowls: number of flat pieces of the collision wall, the first centred on +x; 0 for a round wall.
        grasps: meshes: grasps from `antipodal.surface_grasps`.
    """

    kind: Literal["box", "cylinder", "sphere", "bowl", "mesh"]
    half: tuple[float, float, float]
    wall: float = 0.0045
    lean: float = 0.197
    facets: int = BOWL_FACETS
    grasps: SurfaceGrasps | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Options:
    """Options of the search and scoring of grasp candidates. Lengths [m], angles [rad]."""

    floor_gap: float = 0.006
    """Least gap between the gripper and the surface that the object rests on."""
    palm_gap: float = 0.005
    """Least gap between palm and object."""
    retreat: float = 0.10
    """Distance from the grasp at which the straight approach begins."""
    spread: float = 0.036
    """Opening of the fingers on the approach minus the width of the grasp."""
    fan: int = 24
    """Number of directions of approach around each closing line."""
    shallower: tuple[float, ...] = (0.0,)
    """Distances from the deepest possible position of the hand, along the approach, at which grasps are made."""
    leans: tuple[float, ...] = (0.0, 0.2, -0.2, 0.4)
    """Angles of the approach to a bowl from the direction along its wall, positive outwards."""
    inward: tuple[float, float] | None = None
    """Horizontal unit direction into a shelf; approaches against it are left out."""
    cells: int = 15
    """Points sampled along each side of a box face."""
    slants: tuple[float, ...] = ()
    """Angles between the level direction of the hand and an upright side of a box, at which one finger meets that side
    and the other one the opposite edge; none: grasps of boxes are parallel to their sides."""
    scant: float = 0.0
    """Score lost per metre by which the square root of the contact area on flat sides is below 2 cm."""
    least_clear_m: float = 0.0
    """Least clearance of the approach from neighbours; grasps with less are left out."""
    preference: dict[str, float] = field(
        default_factory=lambda: {"top": 1.0, "tilted": 0.8, "side": 0.5}
    )
    """Score by kind of approach, see `candidates.KINDS`."""


@dataclass(frozen=True, eq=False)
class Pinch:
    """A line on which the pads close on an object, with A directions of approach."""

    closing: Array
    """(3,) unit direction in which the pads close."""
    approach: Array
    """(A, 3) unit directions along the fingers."""
    locus: Array
    """(P, 3) midpoints of the pairs of points at which the two pads can touch the object."""
    width: float
    """Distance [m] between the pads in contact."""
    at: Array | None = None
    """(A, 3) position of the tcp for each approach; None: as deep as palm and support allow."""
    bonus: float = 0.0
    """Added to the score."""
    least: float = 0.010
    """Least length of the locus (or square root of its area) [m] within the pads."""
    measure: float = 0.0
    """Length (or square root of the area) of the whole locus [m]; 0 for a point."""
    planar: bool = False
    """The locus samples an area, not a line."""
    most_open: float = np.inf
    """Widest opening [m] of the approach; with a wider one a finger touches another part of the object."""

    @property
    def point(self) -> bool:
        """Whether each pad touches the object in a single point."""
        return len(self.locus) == 1


def pinches_of(
    shape: ObjectShape, pos: Array, rot: Array, gripper: Gripper, options: Options
) -> Iterator[Pinch]:
    """Yield the pinches of a shape at world position ``pos`` (3,) and rotation ``rot`` (3, 3).

    Raises:
        UsageError: unknown kind of shape.
    """
    makers = {
        "box": _box_pinches,
        "cylinder": _cylinder_pinches,
        "sphere": _sphere_pinches,
        "bowl": _bowl_pinches,
        "mesh": _mesh_pinches,
    }
    if shape.kind not in makers:
        raise unknown_name("object shape", shape.kind, makers)
    return makers[shape.kind](shape, pos, rot, gripper, options)


def _box_pinches(
    shape: ObjectShape, pos: Array, rot: Array, gripper: Gripper, options: Options
) -> Iterator[Pinch]:
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
        yield Pinch(rot[:, i], fan, face, width, least=0.014, measure=size, planar=True)
    yield from _slanted_pinches(shape, pos, rot, gripper, options)


def _slanted_pinches(
    shape: ObjectShape, pos: Array, rot: Array, gripper: Gripper, options: Options
) -> Iterator[Pinch]:
    """Yield pinches of one end of an upright box by a hand that is turned to its sides by one of ``options.slants``.

    One finger meets a side, the other the edge between the opposite side and the end of the box. A force along the line
    between these contacts is within the friction cones of both, and the grasp test allows normals 30 degrees off.
    """
    up = int(np.argmax(np.abs(rot[2])))
    if not options.slants or abs(rot[2, up]) < MIN_UPRIGHT_COSINE:
        return
    for i in range(3):
        if i == up or 2 * shape.half[i] > gripper.usable:
            continue
        j = 3 - up - i
        for sign in (1.0, -1.0):
            for slant in options.slants:
                for side in (1.0, -1.0):
                    end = _BoxEnd(sign * rot[:2, j], shape.half[j], shape.half[i], shape.half[up])
                    found = _slanted_pinch(end, pos, slant, side, gripper, options)
                    if found is not None:
                        yield found


@dataclass(frozen=True, eq=False)
class _BoxEnd:
    """The end of an upright box from which the hand comes.

    along: (2,) unit vector from it to the other end. length, width, height: halves of those of the box.
    """

    along: Array
    length: float
    width: float
    height: float


def _slanted_pinch(
    end: _BoxEnd, pos: Array, slant: float, side: float, gripper: Gripper, options: Options
) -> Pinch | None:
    """Pinch of the end of a box at ``pos`` (3,) by a hand turned by ``slant`` to the left (``side`` 1) or right (-1);
    None if it does not fit into the hand.

    The depth is that of a level hand: the upper edge of a palm that points down shoves the box by up to 2 cm.
    """
    turn = np.cos(slant) * end.along + side * np.sin(slant) * np.array(
        [-end.along[1], end.along[0]]
    )
    # The finger on this side meets the edge that is deeper between the fingers, the other one the opposite side.
    across = side * np.array([-turn[1], turn[0]])
    edge_depth = 2 * end.width * np.sin(slant)
    depth = max(edge_depth + SLANT_EDGE_M, SLANT_DEPTH_M)
    width = 2 * end.width * np.cos(slant) + depth * np.tan(slant)
    if depth > gripper.finger[0] - gripper.palm_x[1] - options.palm_gap:
        return None
    if width > gripper.opening - 2 * SLANT_PLAY_M:
        return None
    normal = np.array([-end.along[1], end.along[0]]) * side
    # Seen along ``turn`` the edge on the side of -normal comes last.
    edge = -end.length * end.along - end.width * normal
    front = -end.length * end.along + end.width * normal
    if edge @ turn < front @ turn:
        edge, front = front, edge
    tip = front @ turn + depth
    away = np.sign(front @ across - edge @ across)
    middle = edge @ across + away * width / 2
    locus = np.column_stack(
        [np.tile(pos[:2] + edge, (41, 1)), pos[2] + np.linspace(-1.0, 1.0, 41) * end.height]
    )
    approach = []
    at = []
    for fall in SLANT_FALLS:
        level = np.sqrt(1.0 - fall**2)
        centre = (tip - gripper.finger[0] * level) * turn + middle * across
        for share in SLANT_HEIGHTS:
            approach.append([*(level * turn), -fall])
            height = share * max(end.height - gripper.finger[1], 0.0) + gripper.finger[0] * fall
            at.append([*(pos[:2] + centre), pos[2] + height])
    return Pinch(
        np.array([*across, 0.0]),
        np.array(approach),
        locus,
        float(width),
        np.array(at),
        bonus=-SLANT_BASE_COST - SLANT_BOX_COST_PER_RAD * slant,
        measure=2 * end.height,
    )


@dataclass(frozen=True, eq=False)
class _Can:
    """A cylinder in the world: radius, half length, centre (3,), unit axis (3,), points (P, 3) along the axis."""

    radius: float
    half: float
    pos: Array
    axis: Array
    line: Array


def _cylinder_pinches(
    shape: ObjectShape, pos: Array, rot: Array, gripper: Gripper, options: Options
) -> Iterator[Pinch]:
    radius = shape.half[0]
    half = shape.half[2]
    axis = rot[:, 2]
    line = pos + np.linspace(-half, half, 81)[:, None] * axis
    can = _Can(radius, half, pos, axis, line)
    for angle in np.arange(12) * np.pi / 12:
        closing = np.cos(angle) * rot[:, 0] + np.sin(angle) * rot[:, 1]
        if 2 * radius <= gripper.usable:
            yield Pinch(
                closing, _fan(closing, axis, options.fan), line, 2 * radius, measure=2 * half
            )
        else:
            yield from _chord_pinches(can, closing, gripper)
            yield from _tip_pinches(can, closing, gripper)
    if 2 * half <= gripper.usable:
        u, v = np.meshgrid(np.linspace(-1, 1, 15) * radius, np.linspace(-1, 1, 15) * radius)
        disk = np.stack([u.ravel(), v.ravel()], axis=1)
        disk = disk[np.linalg.norm(disk, axis=1) <= radius] @ rot[:, :2].T + pos
        size = np.sqrt(np.pi) * radius
        yield Pinch(
            axis,
            _fan(axis, rot[:, 0], options.fan),
            disk,
            2 * half,
            least=0.014,
            measure=size,
            planar=True,
        )


def _chord_pinches(can: _Can, closing: Array, gripper: Gripper) -> Iterator[Pinch]:
    """Yield pinches of a can wider than the opening, with approaches along its axis: the pads grasp a chord.

    The surface normals deviate from the closing line by asin(offset / radius), 21 degrees for the widest can of the
    benchmark; the pads' friction coefficient is above the tangent of that. The grasp test allows 30 degrees, and the
    angle grows as the can slips along the pads: so the chord is as wide as the opening minus the play.
    """
    width = gripper.opening - 2 * CHORD_PLAY_M
    if width / 2 >= can.radius or can.radius - width / 2 > 0.012:
        return
    offset = float(np.sqrt(can.radius**2 - (width / 2) ** 2))
    across = np.cross(can.axis, closing)
    for side in (-1.0, 1.0):
        chord = can.line + side * offset * across
        for down in (-can.axis, can.axis):
            deep = min(can.half, gripper.finger[0] + 0.027)
            at = (
                can.pos
                - down * (can.half - deep + gripper.finger[0])
                + side * (offset + gripper.finger[1]) * across
            )
            yield Pinch(
                closing, down[None], chord, width, at[None], bonus=-0.4, measure=2 * can.half
            )


def _tip_pinches(can: _Can, closing: Array, gripper: Gripper) -> Iterator[Pinch]:
    """Yield pinches of a can slightly wider than the opening, with approaches from the side.

    The round edges of the fingertips grasp a chord in front of the axis. Grasps are the less stable the farther the
    chord is from the axis, so that the hand goes as deep as its opening allows.
    """
    width = gripper.opening - 2 * gripper.play
    if not 0.0 < can.radius - width / 2 < 0.004:
        return
    offset = float(np.sqrt(can.radius**2 - (width / 2) ** 2))
    tip = gripper.finger[0]
    heights = np.linspace(-1.0, 1.0, 7)[:, None] * max(can.half - gripper.finger[1], 0.0) * can.axis
    for side in (-1.0, 1.0):
        approach = side * np.cross(can.axis, closing)
        at = can.pos + heights - (offset + tip) * approach
        chord = can.line - (offset + 1e-4) * approach
        yield Pinch(
            closing,
            np.tile(approach, (len(at), 1)),
            chord,
            width,
            at,
            bonus=-0.6,
            measure=2 * can.half,
        )


def _sphere_pinches(
    shape: ObjectShape, pos: Array, rot: Array, gripper: Gripper, options: Options
) -> Iterator[Pinch]:
    width = 2 * max(shape.half)
    if width > gripper.usable:
        return
    for angle in np.arange(8) * np.pi / 8:
        closing = np.array([np.cos(angle), np.sin(angle), 0.0])
        yield Pinch(
            closing, _fan(closing, np.array([0.0, 0.0, 1.0]), options.fan), pos[None], width
        )


def _bowl_pinches(
    shape: ObjectShape, pos: Array, rot: Array, gripper: Gripper, options: Options
) -> Iterator[Pinch]:
    """Yield pinches of a bowl's wall, one finger inside and one outside, with several angles at each place."""
    axis = rot[:, 2]
    half = shape.half[2]
    count = shape.facets or BOWL_FACETS
    # The middle of a flat facet is nearer to the axis than its corners.
    radius = (shape.half[0] - shape.wall / 2) * (np.cos(np.pi / count) if shape.facets else 1.0)
    for angle in np.arange(count) * 2 * np.pi / count:
        out = np.cos(angle) * rot[:, 0] + np.sin(angle) * rot[:, 1]
        rim = pos + half * axis + radius * out
        for extra in options.leans:
            lean = shape.lean + extra
            down = -np.cos(lean) * axis - np.sin(lean) * out
            closing = np.cos(lean) * out - np.sin(lean) * axis
            wall = rim + np.linspace(0.0, 0.03, 16)[:, None] * down
            # The more the hand leans, the higher the outer fingertip touches the wall.
            at = rim[None] + (0.002 - 0.02 * max(extra - 0.4, 0.0)) * down
            yield Pinch(closing, down[None], wall, shape.wall, at, bonus=-abs(extra), measure=0.03)


def _mesh_pinches(
    shape: ObjectShape, pos: Array, rot: Array, gripper: Gripper, options: Options
) -> Iterator[Pinch]:
    """Yield the surface grasps of a mesh, without those that approach from below."""
    grasps = shape.grasps
    if grasps is None:
        raise UsageError("a shape of kind 'mesh' needs the grasps that were found on it.")
    approach = grasps.approach @ rot.T
    closing = grasps.closing @ rot.T
    tcp = pos + grasps.pos @ rot.T
    contact = pos + grasps.contact @ rot.T
    bonus = (
        PATCH_BONUS_PER_M * np.minimum(grasps.patch, FULL_PATCH_M)
        - SLANT_COST_PER_RAD * grasps.slant
    )
    for k in np.flatnonzero(approach[:, 2] <= MAX_APPROACH_RISE):
        yield Pinch(
            closing[k],
            approach[k : k + 1],
            contact[k : k + 1],
            float(grasps.width[k]),
            tcp[k : k + 1],
            float(bonus[k]),
            most_open=float(grasps.most_open[k]),
        )


def _fan(closing: Array, start: Array, count: int) -> Array:
    """Return ``count`` unit directions of approach (A, 3) around a closing line, without those from below."""
    u = start - closing * (start @ closing)
    u = u / np.linalg.norm(u)
    angle = np.arange(count) * 2 * np.pi / count
    fan = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * np.cross(closing, u)
    return fan[fan[:, 2] <= MAX_APPROACH_RISE]
