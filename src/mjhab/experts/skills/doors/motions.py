"""Searches, in the plan frame of a door, for motions from which it can be pulled open or pushed shut.

The plan frame is that of `planning.link_motions.Frame`. Lengths [m], angles [rad]. Letters: N base paths, K way points.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.envs.parts.world_view import JointedLink
from mjhab.experts.arm import ik, motion
from mjhab.experts.planning import link_motions
from mjhab.experts.planning.link_motions import HandPaths, LinkMotions
from mjhab.robots.robot import Robot

PRE_GRASP_M = 0.11
"""Distance from which the open hand moves straight onto the bar."""
ABOVE_MIDDLE_M = 0.13
"""Height above the middle of the bar at which it is grasped; it is nearer to the rest position of the hand."""
THICK_BAR_M = 0.035
"""Thickness above which a bar hardly rotates between the finger pads, so that the hand must stay square to it."""
PRESS_AHEAD_RAD = 0.2
"""Angle between an open door and the door angle at which the hand's path behind it begins."""
PRESS_PAST_RAD = 0.02
"""Angle beyond the closed door at which the hand's path ends."""
ABOVE_BAR_M = 0.13
"""Height above the end of the bar at which the door is pushed; lower, the hand's side touches the bar."""
FROM_EDGE_M = 0.06
"""Least distance from the free edge of the door at which it is pushed."""
HALF_OPEN_SHARE = 0.95
"""Share of the range below which a door counts as half open: the hand's path begins there, see `push_half_open`."""
OPEN_TO_SHARE = 0.775
"""Share of the range to which a door is pulled; 0.75 counts as open."""
TOUCH_M = 0.001
"""Distance of the fingertips from a door that they push."""
PUSH_YAWS_RAD = ((0.25, 0.4), (0.5, 0.4), (0.8, 0.4), (1.1, 0.4))
"""Pairs of yaws of the pushing hand, at the open and at the closed door; 0 points straight at the furniture. The first
pair is for half open doors only: behind a door that is open by 2.2 rad, a hand at yaw 0.6 is parallel to it, and at
smaller yaws the hand touches the edge of the door on its way in."""


def pull_angles(link: JointedLink, further: float = 0.0) -> np.ndarray:
    """Door angles (10,) [rad] of the way points of `pull_motions`; at the first the hand is in front of the bar.

    ``further``: share of the range beyond `OPEN_TO_SHARE` to which the door is pulled.
    """
    return np.append(
        # A value of its own for the hand before the bar, so that the path is a function of the door angle there, too.
        -0.01,
        np.linspace(0.0, (OPEN_TO_SHARE + further + 0.03) * link.range[1], 9),
    )


def push_angles(link: JointedLink, half: bool) -> np.ndarray:
    """Door angles (11,) [rad] of the way points of `push_half_open` or `push_open`, from open to closed."""
    first = (HALF_OPEN_SHARE * link.range[1]) if half else link.range[1] + PRESS_AHEAD_RAD
    return np.append(np.linspace(first, 0.0, 10), -PRESS_PAST_RAD)


def hand_side(link: JointedLink) -> float:
    """1 for a door with its bar at negative y, the left as seen from outside; -1 for its mirror image."""
    # The hinge lies opposite to the bar, and the plan frame has its origin at the hinge.
    return -float(np.sign(link.handle.pos[1]))


def _inward(link: JointedLink) -> float:
    """Offset along y from the bar to the pushed point, at least `FROM_EDGE_M` from the edge; 0 for most doors."""
    m = hand_side(link)
    (low, high) = panel(link)
    edge = (low if m > 0 else high)[1]
    lack = FROM_EDGE_M - abs(edge - link.handle.pos[1])
    # Less than a millimetre would only make another key of cached motions for no difference in contact.
    return m * lack if lack > 0.001 else 0.0


def line(
    near: np.ndarray,
    side: np.ndarray,
    headings: Iterable[float],
    lengths: tuple[float, ...],
    share: np.ndarray,
) -> np.ndarray:
    """Generate straight base paths (N, K, 3) for all combinations of start point, heading and length.

    Args:
        near: (X,) x of the start points.
        side: (Y,) y of the start points.
        headings: directions of the paths; the base faces the opposite direction.
        lengths: lengths of the paths, negative towards the furniture.
        share: (K,) share of the path at every way point.
    """
    out = []
    for x, y, heading, length in product(near, side, headings, lengths):
        back = motion.ahead(heading) * length
        out.append(
            np.c_[
                np.array([x, y]) + share[:, None] * back,
                np.full(len(share), np.pi + heading),
            ]
        )
    return np.array(out)


def _in_reach(robot: Robot, base: np.ndarray, hands: np.ndarray) -> np.ndarray:
    """(N,) bool: base paths (N, K, 3) along which the shoulder stays within arm's reach of the hand (K, 3)."""
    yaw = base[..., 2]
    shoulder_ahead = robot.reach.ahead + robot.reach.out
    nearest, farthest = robot.reach.level
    shoulder = base[..., :2] + shoulder_ahead * np.stack(
        [np.cos(yaw), np.sin(yaw)], axis=-1
    )
    far = np.linalg.norm(shoulder - hands[None, :, :2], axis=-1)
    return (far.max(axis=1) < farthest) & (far.min(axis=1) > nearest)


def panel(link: JointedLink) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest corner (3,) of the closed door's largest box, its panel."""
    boxes = link.boxes(0.0)
    # Handles and frames are boxes of the door as well, and all are smaller than the panel.
    k = int(np.argmax(boxes.half.prod(axis=1)))
    reach = np.abs(boxes.rot[k]) @ boxes.half[k]
    return boxes.center[k] - reach, boxes.center[k] + reach


def _carcass(link: JointedLink) -> Boxes:
    """Box of the furniture behind the closed door."""
    low, high = panel(link)
    # The boxes of the home are not known here: motions are cached per link for all homes, so a block of usual depth
    # stands for the body.
    middle = np.array([low[0] - 0.006 - 0.31, (low[1] + high[1]) / 2, 0.975])
    return Boxes(
        middle[None], np.array([[0.31, (high[1] - low[1]) / 2, 0.975]]), np.eye(3)[None]
    )


def _with_door(link: JointedLink, angle: float) -> Boxes:
    """Boxes of the furniture and of the door at an angle [rad]."""
    parts = (_carcass(link), link.boxes(max(angle, 0.0)))
    return Boxes.join(parts)


def _level(yaw: np.ndarray) -> np.ndarray:
    """Hand rotations (K, 3, 3): horizontal, opposite to the directions ``yaw`` (K,), with the fingers side by side."""
    forward = -np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], axis=-1)
    return link_motions.hand(
        forward, np.stack([-forward[:, 1], forward[:, 0], 0.0 * yaw], axis=-1)
    )


@dataclass(frozen=True, eq=False)
class HandPath:
    """Hand positions ``pos`` (K, 3) and rotations ``rot`` (K, 3, 3) in the plan frame at door ``angles`` (K,)."""

    pos: np.ndarray
    rot: np.ndarray
    angles: np.ndarray


def search(
    robot: Robot,
    link: JointedLink,
    base: np.ndarray,
    hands: HandPath,
    tries: int,
    mode: ik.Mode = "pose",
) -> LinkMotions:
    """Find motions that follow one hand path, among the base paths (N, K, 3) within arm's reach of it.

    ``tries``: see `link_motions.track`. ``mode``: part of the orientation that counts, see `ik.Mode`.
    """
    # Inverse kinematics takes nearly all of the time, and most base paths fail by their distance alone.
    base = base[_in_reach(robot, base, hands.pos)]
    n = len(base)
    paths = HandPaths(
        base,
        np.broadcast_to(hands.pos, (n, *hands.pos.shape)),
        np.broadcast_to(hands.rot, (n, *hands.rot.shape)),
        mode,
    )
    doors = [_with_door(link, float(a)) for a in hands.angles]
    return link_motions.track(robot, paths, doors, tries=tries)


def pull_motions(robot: Robot, link: JointedLink, further: float = 0.0) -> LinkMotions:
    """Find motions for pulling a door open: hand in front of the bar, on it, and along its arc.

    The hand rotates less than the door, because the bar can rotate between the finger pads.

    Args:
        robot: the robot.
        link: the door.
        further: share of the range beyond `OPEN_TO_SHARE` to which the door is pulled.
    """
    angles = pull_angles(link, further)
    grip = np.array([link.handle_pose(max(a, 0.0))[0] for a in angles])
    # The bar is long: any height of it will do, and this one needs less of the arm.
    grip[:, 2] += ABOVE_MIDDLE_M
    share = np.clip(angles / angles[-1], 0.0, 1.0)
    m = hand_side(link)
    thick = link.handle.thickness > THICK_BAR_M
    headings = m * np.array([0.6, 0.9, 1.2, 1.5] if thick else [0.3, 0.6, 0.9])
    lengths = (0.5, 0.65, 0.8, 0.95) if thick else (0.4, 0.6)
    base = line(
        np.arange(0.8, 1.25, 0.1),
        m * np.arange(-0.85, 0.15, 0.15),
        headings,
        lengths,
        share,
    )
    found = []
    for first, last in (
        # A thick bar cannot turn between the pads, so that the hand has to turn with the door.
        ((0.0, 0.6), (0.0, 1.2), (0.15, 0.7)) if thick else ((0.4, 0.6), (0.8, 0.7))
    ):
        yaw = m * (first + (last - first) * share)
        pos = grip.copy()
        pos[0] += PRE_GRASP_M * motion.ahead_3d(yaw[0])
        found.append(
            search(robot, link, base, HandPath(pos, _level(yaw), angles), tries=5)
        )
    return LinkMotions.join(found)


def push_open(robot: Robot, link: JointedLink) -> LinkMotions:
    """Find motions for pushing a door shut that may be open up to its limit."""
    return _push_motions(robot, link, half=False)


def push_half_open(robot: Robot, link: JointedLink) -> LinkMotions:
    """Find motions for pushing a door shut that is open by less than `HALF_OPEN_SHARE`."""
    return _push_motions(robot, link, half=True)


def _push_motions(robot: Robot, link: JointedLink, half: bool) -> LinkMotions:
    """Motions with the closed fingers on the outside of the door above its bar, from the open to the closed door."""
    angles = push_angles(link, half)
    share = np.clip(1.0 - angles / angles[0], 0.0, 1.0)
    # Negative: the base faces the furniture and drives towards it while the door shuts.
    lengths = (-1.0, -0.8, -0.6, -0.4)
    m = hand_side(link)
    headings = m * np.array([0.2, 0.45, 0.7, 0.95, 1.2])
    base = line(
        np.arange(0.8, 1.7, 0.1), m * np.arange(-0.1, 1.25, 0.1), headings, lengths, share
    )
    handle = link.handle
    face = panel(link)[1][0]
    tip = robot.gripper.finger[0] + TOUCH_M
    # The closed fingers lie side by side.
    side = robot.gripper.thickness
    inward = _inward(link)
    found = []
    for first, last in PUSH_YAWS_RAD if half else PUSH_YAWS_RAD[1:]:
        yaw = first + (last - first) * share
        # The angle between fingers and door decides how far their thickness reaches beyond the tips.
        lag = angles - yaw
        gap = (
            face + tip * np.abs(np.cos(lag)) + side * np.abs(np.sin(lag)) - handle.pos[0]
        )
        pos = []
        for angle, more in zip(angles, gap, strict=True):
            at, bar, out = link.handle_pose(float(angle))
            across = np.array([-out[1], out[0], 0.0])
            pos.append(
                at
                + more * out
                + inward * across
                + (handle.half_length + ABOVE_BAR_M) * bar
            )
        hands = HandPath(np.array(pos), _level(m * yaw), angles)
        # Few motions reach behind a wide open door: more tries there.
        tries = 5 if half else 8
        found.append(search(robot, link, base, hands, tries=tries, mode="approach"))
    return LinkMotions.join(found)
