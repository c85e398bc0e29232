"""Pinches: lines on which the two pads of a parallel gripper close on an object, with directions of approach.

Gripper frame as in `candidates`. Lengths [m], world frame. Letters: A directions of approach, P points of contact.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mjhab.core.errors import UsageError, unknown_name
from mjhab.episodes.grasps.box_pinches import box_pinches
from mjhab.episodes.grasps.cylinder_pinches import cylinder_pinches
from mjhab.episodes.grasps.pinch import (
    MAX_APPROACH_RISE,
    ObjectShape,
    Pinch,
    PinchOptions,
    fan_of,
)
from mjhab.robots.parts import Gripper
from mjhab.scenes.builtin.objects import BOWL_FACETS

FULL_PATCH_M = 0.025
"""Square root of the contact area of the pads above which more area does not increase a mesh grasp's score."""
PATCH_BONUS_PER_M = 40.0
"""Score of a mesh grasp per metre of the square root of the pads' contact area."""
SLANT_COST_PER_RAD = 4.0
"""Score that a mesh grasp loses per radian between its closing line and the surface normals."""


def pinches_of(
    shape: ObjectShape,
    pos: np.ndarray,
    rot: np.ndarray,
    gripper: Gripper,
    options: PinchOptions,
) -> Iterator[Pinch]:
    """Yield the pinches of a shape at world position ``pos`` (3,) and rotation ``rot`` (3, 3).

    Raises:
        UsageError: unknown kind of shape.
    """
    makers = {
        "box": box_pinches,
        "cylinder": cylinder_pinches,
        "sphere": _sphere_pinches,
        "bowl": _bowl_pinches,
        "mesh": _mesh_pinches,
    }
    if shape.kind not in makers:
        raise unknown_name("object shape", shape.kind, makers)
    return makers[shape.kind](shape, pos, rot, gripper, options)


def _sphere_pinches(
    shape: ObjectShape,
    pos: np.ndarray,
    rot: np.ndarray,
    gripper: Gripper,
    options: PinchOptions,
) -> Iterator[Pinch]:
    # Spheres stand for rounded objects with unequal axes as well: the widest decides.
    width = 2 * max(shape.half)
    if width > gripper.usable:
        return
    for angle in np.arange(8) * np.pi / 8:
        closing = np.array([np.cos(angle), np.sin(angle), 0.0])
        yield Pinch(
            closing,
            fan_of(closing, np.array([0.0, 0.0, 1.0]), options.fan),
            pos[None],
            width,
        )


def _bowl_pinches(
    shape: ObjectShape,
    pos: np.ndarray,
    rot: np.ndarray,
    gripper: Gripper,
    options: PinchOptions,
) -> Iterator[Pinch]:
    """Yield pinches of a bowl's wall, one finger inside and one outside, with several angles at each place."""
    axis = rot[:, 2]
    half = shape.half[2]
    count = shape.facets or BOWL_FACETS
    # The middle of a flat facet is nearer to the axis than its corners.
    radius = (shape.half[0] - shape.wall / 2) * (
        np.cos(np.pi / count) if shape.facets else 1.0
    )
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
            yield Pinch(
                closing, down[None], wall, shape.wall, at, bonus=-abs(extra), measure=0.03
            )


def _mesh_pinches(
    shape: ObjectShape,
    pos: np.ndarray,
    rot: np.ndarray,
    gripper: Gripper,
    options: PinchOptions,
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
