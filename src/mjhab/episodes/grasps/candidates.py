"""Grasp candidates of a parallel gripper on boxes, cylinders, spheres, bowls and meshes, in any pose.

Gripper frame: origin between the finger pads (the tcp), x along the fingers, y the line on which they close, z across
them. Lengths [m], world frame. Letters: G grasps, K neighbour boxes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjhab.core.arithmetic.elementary import arccos
from mjhab.core.boxes import Boxes, nearest_box_distance
from mjhab.core.rotations import frame_from_axes, mat_from_quat, quat_from_mat
from mjhab.episodes.grasps.pinch import ObjectShape, Pinch, PinchOptions
from mjhab.episodes.grasps.pinches import pinches_of
from mjhab.robots.parts import Gripper
from mjhab.robots.registry import robot_named

KINDS = ("top", "tilted", "side")
"""Kinds of approach: "top" within 20 degrees of straight down, "side" within 20 degrees of level, else "tilted"."""


FINGER_SPHERE_RADIUS = 0.0115
"""Radius [m] of the five spheres along every finger."""


@dataclass(frozen=True, eq=False)
class Grasps:
    """G grasp candidates, best first.

    Attributes:
        pos: (G, 3) position of the tcp in the grasp.
        rot: (G, 3, 3) rotation of the tcp frame.
        pre: (G, 3) position of the tcp at the start of the straight approach.
        width: (G,) distance between the pads in contact.
        opening: (G,) distance between the pads on the approach.
        clear: (G,) least clearance from the neighbours on the approach.
        kind: (G,) index into `KINDS`.
        score: (G,) higher is better.
    """

    pos: np.ndarray
    rot: np.ndarray
    pre: np.ndarray
    width: np.ndarray
    opening: np.ndarray
    clear: np.ndarray
    kind: np.ndarray
    score: np.ndarray

    def __len__(self) -> int:
        return len(self.pos)

    @property
    def quat(self) -> np.ndarray:
        """Rotations as quaternions (G, 4) wxyz."""
        return quat_from_mat(self.rot)

    def take(self, rows: np.ndarray) -> Grasps:
        """Return the candidates of row indices, a slice or a mask."""
        return Grasps(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class LyingObject:
    """An object at world pose ``pos`` (3,), ``rot`` (3, 3), on a support at height ``support_z``."""

    shape: ObjectShape
    pos: np.ndarray
    rot: np.ndarray
    support_z: float

    @classmethod
    def of(cls, shape: ObjectShape, pose: np.ndarray, support_z: float) -> LyingObject:
        """Make a lying object from a world pose (7,) [m, wxyz]."""
        pose = np.asarray(pose, dtype=np.float64)
        return cls(shape, pose[:3], mat_from_quat(pose[3:]), support_z)


def grasp_candidates(
    obj: LyingObject,
    *,
    neighbours: Boxes | None = None,
    robot_xy: np.ndarray | None = None,
    gripper: Gripper | None = None,
    options: PinchOptions | None = None,
) -> Grasps:
    """Return the grasp candidates of one object, best first; none if it cannot be grasped in its pose.

    Args:
        obj: the object in its pose; the gripper stays above its support.
        neighbours: boxes (other objects, drawer walls, shelves above) that the gripper must not touch on the approach.
        robot_xy: (2,) position of the robot: approaches away from it score higher.
        gripper: sizes of the gripper; None for the default robot's.
        options: options of search and scoring; None for the defaults.

    Raises:
        UsageError: unknown kind of shape.
    """
    gripper = gripper or robot_named().gripper
    options = options or PinchOptions()
    pinches = pinches_of(obj.shape, obj.pos, obj.rot, gripper, options)
    parts = [_place(pinch, obj, gripper, options) for pinch in pinches]
    if not any(len(part[0]) for part in parts):
        return _empty()
    tcp, turn, width, opening, quality = (
        np.concatenate([part[i] for part in parts]) for i in range(5)
    )
    # The gripper is symmetric under half a turn about x: each grasp has a second wrist angle.
    flip = turn * np.array([1.0, -1.0, -1.0])
    tcp = np.tile(tcp, (2, 1))
    turn = np.concatenate([turn, flip])
    width = np.tile(width, 2)
    quality = np.tile(quality, 2)
    opening = np.tile(opening, 2)
    pre = tcp - options.retreat * turn[:, :, 0]
    clear = approach_clearance(tcp, turn, opening, pre, neighbours, gripper)
    kind, score = _score(obj.pos, turn, quality, clear, robot_xy, options)
    found = Grasps(tcp, turn, pre, width, opening, clear, kind, score)
    order = np.argsort(-score, kind="stable")
    # Filtered after sorting: an order by score stays one.
    return found.take(order[clear[order] >= options.least_clear_m])


def gripper_spheres(
    opening: np.ndarray, gripper: Gripper | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return spheres that cover fingers, hand and wrist.

    Args:
        opening: (G,) distance between the pads.
        gripper: sizes of the gripper; None for the default robot's.

    Returns:
        Centres (G, S, 3) in the gripper frame, and radii (S,).
    """
    gripper = gripper or robot_named().gripper
    along = np.linspace(-0.018, gripper.finger[0] - 0.009, 5)
    side = opening / 2 + gripper.thickness / 2
    fingers = np.zeros((len(opening), 10, 3))
    fingers[:, :, 0] = np.tile(along, 2)
    fingers[:, :5, 1] = side[:, None]
    fingers[:, 5:, 1] = -side[:, None]
    centers = np.array([sphere.center for sphere in gripper.hand])
    hand = np.broadcast_to(centers, (len(opening), *centers.shape))
    radii = np.array(
        [FINGER_SPHERE_RADIUS] * 10 + [sphere.radius for sphere in gripper.hand]
    )
    return np.concatenate([fingers, hand], axis=1), radii


def approach_clearance(
    pos: np.ndarray,
    rot: np.ndarray,
    opening: np.ndarray,
    pre: np.ndarray,
    neighbours: Boxes | None,
    gripper: Gripper | None = None,
) -> np.ndarray:
    """Return the least clearance (G,) [m] of the gripper from boxes on straight approaches; 1 without boxes.

    Args:
        pos: (G, 3) position of the tcp at the end of the approach.
        rot: (G, 3, 3) rotation of the tcp frame.
        opening: (G,) distance between the pads.
        pre: (G, 3) position of the tcp at the start of the approach.
        neighbours: the boxes.
        gripper: sizes of the gripper; None for the default robot's.
    """
    if neighbours is None or len(neighbours) == 0:
        return np.full(len(pos), 1.0)
    local, radius = gripper_spheres(opening, gripper)
    turned = np.einsum("gij,gmj->gmi", rot, local)
    least = np.full(len(pos), np.inf)
    # Closer together near the object, where neighbours are.
    for share in (0.0, 0.25, 0.5, 1.0):
        points = (pos + share * (pre - pos))[:, None] + turned
        gap = nearest_box_distance(points.reshape(-1, 3), neighbours).reshape(
            points.shape[:2]
        )
        least = np.minimum(least, (gap - radius).min(axis=1))
    return least


def _extent(shape: ObjectShape, rot: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the half-extent (...,) of an object at rotation ``rot`` along unit directions (..., 3)."""
    part = np.abs(direction @ rot)
    if shape.kind == "box":
        return part @ np.array(shape.half)
    if shape.kind == "sphere":
        return np.full(part.shape[:-1], max(shape.half))
    return (
        shape.half[0] * np.hypot(part[..., 0], part[..., 1])
        + shape.half[2] * part[..., 2]
    )


def _place(
    pinch: Pinch, obj: LyingObject, gripper: Gripper, options: PinchOptions
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the feasible grasps of one pinch: tcp positions (n, 3), rotations (n, 3, 3), widths (n,), openings (n,) on
    the approach, qualities (n,)."""
    approach = pinch.approach
    if options.inward is not None:
        kept = approach[:, :2] @ np.array(options.inward) > -0.25
        pinch = replace(
            pinch,
            approach=approach[kept],
            at=None if pinch.at is None else pinch.at[kept],
        )
        approach = pinch.approach
    turn = frame_from_axes(approach, np.broadcast_to(pinch.closing, approach.shape))
    opening = min(pinch.width + options.spread, pinch.most_open, gripper.opening)
    lowest = _lowest(turn, opening, gripper)
    room = obj.support_z + options.floor_gap - lowest
    if pinch.at is None:
        # As deep as the palm allows, and above the support: whichever comes first.
        reach = _extent(obj.shape, obj.rot, approach)
        across = _extent(obj.shape, obj.rot, turn[:, :, 2])
        shifts = np.maximum(across - 0.015, 0.0)[:, None] * np.array(
            [0.0, -0.5, 0.5, -0.95, 0.95]
        )
        at = obj.pos + shifts[..., None] * turn[:, None, :, 2]
        deepest = -reach - gripper.palm_x[1] - options.palm_gap
        # Level approaches never reach the floor; the bound keeps them from dividing by 0.
        fall = np.maximum(-approach[:, 2], 1e-9)[:, None]
        floor = np.where(fall > 0.05, (at[..., 2] - room[:, None]) / fall, np.inf)
        push = np.minimum(np.minimum(deepest[:, None], floor), 0.0)
        deep = push[..., None] - np.array(options.shallower)
        at = (at[:, :, None] + deep[..., None] * approach[:, None, None]).reshape(-1, 3)
        count = shifts.shape[1] * len(options.shallower)
        turn = np.repeat(turn, count, axis=0)
        room = np.repeat(room, count)
    else:
        at = pinch.at
    held, off = _overlap(pinch, obj.pos, at, turn, gripper)
    # A hand that goes down to the floor lies on this limit, up to rounding.
    keep = (at[:, 2] >= room - 1e-6) & (held >= pinch.least)
    # Narrow objects tolerate larger position errors: the widest leave a gap of 3 mm on each side.
    quality = (
        pinch.bonus
        + 6.0 * np.minimum(held, 0.03)
        - 4.0 * off
        # To the fourth power, so that it matters only for the widest.
        - 0.3 * (pinch.width / gripper.usable) ** 4
    )
    if pinch.planar:
        quality = quality - options.scant * np.maximum(0.02 - held, 0.0)
    count = int(keep.sum())
    widths = np.full(count, pinch.width)
    openings = np.full(count, opening)
    return at[keep], turn[keep], widths, openings, quality[keep]


def _overlap(
    pinch: Pinch, center: np.ndarray, at: np.ndarray, turn: np.ndarray, gripper: Gripper
) -> tuple[np.ndarray, np.ndarray]:
    """Return, for tcp positions ``at`` (A, 3), how much of the contact locus the pads cover (A,) (length or square root
    of area), and the distance (A,) of its middle from the object's centre."""
    local = np.einsum("apj,ajk->apk", pinch.locus - at[:, None], turn)
    edge = np.array(gripper.finger) - (0.007 if pinch.point else -1e-6)
    blunt = gripper.blunt if pinch.planar else 0.0
    inside = (
        (local[:, :, 0] >= -edge[0])
        & (local[:, :, 0] <= edge[0] - blunt)
        & (np.abs(local[:, :, 2]) <= edge[1])
    )
    count = inside.sum(axis=1)
    # Without a point between the pads there is no middle: the bound avoids 0 / 0, and such grasps are left out.
    middle = np.einsum("ap,pj->aj", inside / np.maximum(count, 1)[:, None], pinch.locus)
    share = count / len(pinch.locus)
    held = (
        0.015 * share
        if pinch.point
        # A share of points is one of an area here, and ``held`` is a length.
        else pinch.measure * (np.sqrt(share) if pinch.planar else share)
    )
    return held, np.linalg.norm(middle - center, axis=1)


def _lowest(turn: np.ndarray, opening: float, gripper: Gripper) -> np.ndarray:
    """Return the height (A,) of the lowest corner of fingers and hand relative to the tcp (negative: below)."""
    y = opening / 2 + gripper.thickness
    corners = []
    for sy in (-1.0, 1.0):
        for sz in (-1.0, 1.0):
            corners += [
                (sx * gripper.finger[0], sy * y, sz * gripper.finger[1])
                for sx in (-1.0, 1.0)
            ]
            corners += [
                (px, sy * gripper.palm_half[0], sz * gripper.palm_half[1])
                for px in gripper.palm_x
            ]
    return np.min(turn[:, 2, :] @ np.array(corners).T, axis=1)


def _score(
    pos: np.ndarray,
    turn: np.ndarray,
    quality: np.ndarray,
    clear: np.ndarray,
    robot_xy: np.ndarray | None,
    options: PinchOptions,
) -> tuple[np.ndarray, np.ndarray]:
    approach = turn[:, :, 0]
    fall = np.degrees(arccos(np.clip(-approach[:, 2], -1.0, 1.0)))
    kind = np.where(fall <= 20.0, 0, np.where(fall < 70.0, 1, 2))
    score = (
        quality
        + np.array([options.preference[name] for name in KINDS])[kind]
        # Beyond 3 cm more room is no better, and it must not outweigh the quality.
        + 8.0 * np.clip(clear, -0.03, 0.03)
    )
    if robot_xy is not None:
        away = pos[:2] - np.asarray(robot_xy, dtype=np.float64)[:2]
        away = away / max(float(np.linalg.norm(away, axis=-1)), 1e-6)
        score = score + 0.8 * approach[:, :2] @ away
    return kind, score


def _empty() -> Grasps:
    none = np.zeros(0)
    points = np.zeros((0, 3))
    return Grasps(
        points, np.zeros((0, 3, 3)), points, none, none, none, none.astype(np.int64), none
    )
