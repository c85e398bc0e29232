"""Pinches of boxes: parallel to their sides, and slanted ones of an upright box."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mjhab.episodes.grasps.pinch import ObjectShape, Pinch, PinchOptions, fan_of
from mjhab.robots.parts import Gripper

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


def box_pinches(
    shape: ObjectShape,
    pos: np.ndarray,
    rot: np.ndarray,
    gripper: Gripper,
    options: PinchOptions,
) -> Iterator[Pinch]:
    """Yield the pinches of a box, see `pinches.pinches_of`."""
    for i in range(3):
        width = 2 * shape.half[i]
        if width > gripper.usable:
            continue
        j = (i + 1) % 3
        k = (i + 2) % 3
        cells = np.linspace(-1, 1, options.cells)
        u, v = np.meshgrid(cells * shape.half[j], cells * shape.half[k])
        face = pos + u.reshape(-1, 1) * rot[:, j] + v.reshape(-1, 1) * rot[:, k]
        # The square root of an area, so that grasps of sides and of lines compare.
        size = 2 * np.sqrt(shape.half[j] * shape.half[k])
        fan = fan_of(rot[:, i], rot[:, j], options.fan)
        yield Pinch(rot[:, i], fan, face, width, least=0.014, measure=size, planar=True)
    yield from _slanted_pinches(shape, pos, rot, gripper, options)


def _slanted_pinches(
    shape: ObjectShape,
    pos: np.ndarray,
    rot: np.ndarray,
    gripper: Gripper,
    options: PinchOptions,
) -> Iterator[Pinch]:
    """Yield pinches of one end of an upright box by a hand that is turned to its sides by one of ``options.slants``.

    One finger meets a side, the other the edge between the opposite side and the end of the box. A force along the line
    between these contacts is within the friction cones of both, and the grasp test allows normals 30 degrees off.
    """
    up = int(np.argmax(np.abs(rot[2])))
    # The depth is computed for a level hand at an upright edge.
    if not options.slants or abs(rot[2, up]) < MIN_UPRIGHT_COSINE:
        return
    for i in range(3):
        if i == up or 2 * shape.half[i] > gripper.usable:
            continue
        j = 3 - up - i
        for sign in (1.0, -1.0):
            for slant in options.slants:
                for side in (1.0, -1.0):
                    end = _BoxEnd(
                        sign * rot[:2, j], shape.half[j], shape.half[i], shape.half[up]
                    )
                    found = _slanted_pinch(end, pos, slant, side, gripper, options)
                    if found is not None:
                        yield found


@dataclass(frozen=True, eq=False)
class _BoxEnd:
    """The end of an upright box from which the hand comes.

    along: (2,) unit vector from it to the other end. length, width, height: halves of those of the box.
    """

    along: np.ndarray
    length: float
    width: float
    height: float


def _slanted_pinch(
    end: _BoxEnd,
    pos: np.ndarray,
    slant: float,
    side: float,
    gripper: Gripper,
    options: PinchOptions,
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
    # An edge right at the fingertips would slip off.
    depth = max(edge_depth + SLANT_EDGE_M, SLANT_DEPTH_M)
    width = 2 * end.width * np.cos(slant) + depth * math.tan(slant)
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
        [
            np.tile(pos[:2] + edge, (41, 1)),
            pos[2] + np.linspace(-1.0, 1.0, 41) * end.height,
        ]
    )
    approach = []
    at = []
    for fall in SLANT_FALLS:
        level = np.sqrt(1.0 - fall**2)
        centre = (tip - gripper.finger[0] * level) * turn + middle * across
        for share in SLANT_HEIGHTS:
            approach.append([*(level * turn), -fall])
            height = (
                share * max(end.height - gripper.finger[1], 0.0)
                + gripper.finger[0] * fall
            )
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
