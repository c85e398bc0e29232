"""Pinches of cylinders: across and along the axis, and of cans wider than the opening of the gripper."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mjhab.episodes.grasps.pinch import ObjectShape, Pinch, PinchOptions, fan_of
from mjhab.robots.parts import Gripper

CHORD_PLAY_M = 0.0015
"""Gap between each pad of the open gripper and the chord on which it grasps a can wider than its opening."""


@dataclass(frozen=True, eq=False)
class _Can:
    """A cylinder in the world: radius, half length, centre (3,), unit axis (3,), points (P, 3) along the axis."""

    radius: float
    half: float
    pos: np.ndarray
    axis: np.ndarray
    line: np.ndarray


def cylinder_pinches(
    shape: ObjectShape,
    pos: np.ndarray,
    rot: np.ndarray,
    gripper: Gripper,
    options: PinchOptions,
) -> Iterator[Pinch]:
    """Yield the pinches of a cylinder, see `pinches.pinches_of`."""
    radius = shape.half[0]
    half = shape.half[2]
    axis = rot[:, 2]
    line = pos + np.linspace(-half, half, 81)[:, None] * axis
    can = _Can(radius, half, pos, axis, line)
    # Over half a turn: a closing line has no direction.
    for angle in np.arange(12) * np.pi / 12:
        closing = np.cos(angle) * rot[:, 0] + np.sin(angle) * rot[:, 1]
        if 2 * radius <= gripper.usable:
            yield Pinch(
                closing,
                fan_of(closing, axis, options.fan),
                line,
                2 * radius,
                measure=2 * half,
            )
        else:
            yield from _chord_pinches(can, closing, gripper)
            yield from _tip_pinches(can, closing, gripper)
    if 2 * half <= gripper.usable:
        u, v = np.meshgrid(
            np.linspace(-1, 1, 15) * radius, np.linspace(-1, 1, 15) * radius
        )
        disk = np.stack([u.ravel(), v.ravel()], axis=1)
        # The grid covers the square around the disk.
        disk = disk[np.linalg.norm(disk, axis=1) <= radius] @ rot[:, :2].T + pos
        # The square root of the area of the disk.
        size = np.sqrt(np.pi) * radius
        yield Pinch(
            axis,
            fan_of(axis, rot[:, 0], options.fan),
            disk,
            2 * half,
            least=0.014,
            measure=size,
            planar=True,
        )


def _chord_pinches(can: _Can, closing: np.ndarray, gripper: Gripper) -> Iterator[Pinch]:
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
                closing,
                down[None],
                chord,
                width,
                at[None],
                bonus=-0.4,
                measure=2 * can.half,
            )


def _tip_pinches(can: _Can, closing: np.ndarray, gripper: Gripper) -> Iterator[Pinch]:
    """Yield pinches of a can slightly wider than the opening, with approaches from the side.

    The round edges of the fingertips grasp a chord in front of the axis. Grasps are the less stable the farther the
    chord is from the axis, so that the hand goes as deep as its opening allows.
    """
    width = gripper.opening - 2 * gripper.play
    if not 0.0 < can.radius - width / 2 < 0.004:
        return
    offset = float(np.sqrt(can.radius**2 - (width / 2) ** 2))
    tip = gripper.finger[0]
    heights = (
        np.linspace(-1.0, 1.0, 7)[:, None]
        * max(can.half - gripper.finger[1], 0.0)
        * can.axis
    )
    for side in (-1.0, 1.0):
        approach = side * np.cross(can.axis, closing)
        at = can.pos + heights - (offset + tip) * approach
        # A tenth of a millimetre before the tips, so that rounding does not put the chord past them.
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
