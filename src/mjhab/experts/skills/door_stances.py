"""Where to stand and how to hold the arm to pull a hinged door open or to push it shut: searches in the plan frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.envs.parts.world_view import JointedLink
from mjhab.experts.arm import ik
from mjhab.experts.planning import stances
from mjhab.experts.planning.stances import Stances
from mjhab.robots.robot import Robot

Array = np.ndarray
PRE_GRASP_M = 0.11
"""Distance from which the open hand moves straight onto the bar."""
ABOVE_MIDDLE_M = 0.13
"""Height above the middle of the bar at which it is taken: nearer to where the hand rests."""
THICK_BAR_M = 0.035
"""Thickness from which on a bar hardly turns between the pads, and the hand must take it squarely."""
PRESS_AHEAD_RAD = 0.2
"""Angle between an open door and where the hand begins to push it."""
PRESS_PAST_RAD = 0.02
"""Angle beyond the closed door that the hand aims at."""
ABOVE_BAR_M = 0.13
"""Height above the end of the bar at which the door is pushed: a lower hand catches the bar with its side."""
FROM_EDGE_M = 0.06
"""Least distance from the free edge of the door at which it is pushed."""
HALF_OPEN_SHARE = 0.95
"""Share of the range up to which the hand need not begin as far behind the door as for a wide open one."""
OPEN_TO_SHARE = 0.775
"""Share of the range to which a door is pulled; 0.75 counts as open."""
TIP_M = 0.031
"""Distance of the fingertips before the tool centre."""
FINGER_SIDE_M = 0.0144
"""Half-width of the closed fingers."""
PUSH_YAWS_RAD = ((0.25, 0.4), (0.5, 0.4), (0.8, 0.4), (1.1, 0.4))
"""Yaws of the pushing hand on the open and on the closed door; 0 points straight at the furniture. Behind a door
that is open by 2.2 rad, a hand at 0.6 lies along it, and one at 0 would touch the door's edge with its side on its
way in: the first pair is for doors that are not wide open."""


def pull_angles(link: JointedLink, further: float = 0.0) -> Array:
    """Door angles (10,) [rad] of the way points of `pull_stances`; the first is the hand before the bar.

    ``further``: share of the range beyond `OPEN_TO_SHARE`.
    """
    return np.append(-0.01, np.linspace(0.0, (OPEN_TO_SHARE + further + 0.03) * link.range[1], 9))


def push_angles(link: JointedLink, half: bool) -> Array:
    """Door angles (11,) [rad] of the way points of `push_half_open` or `push_open`, from open to closed."""
    first = (HALF_OPEN_SHARE * link.range[1]) if half else link.range[1] + PRESS_AHEAD_RAD
    return np.append(np.linspace(first, 0.0, 10), -PRESS_PAST_RAD)


def _hand_side(link: JointedLink) -> float:
    """1 for a door with its bar at negative y, to the left as seen from outside, for which the searches are written
    down; -1 for its mirror image."""
    return -float(np.sign(link.handle.pos[1]))


def _inward(link: JointedLink) -> float:
    """Way along y [m] from the bar to where the door is pushed: 0 unless the bar is at the door's very edge."""
    m = _hand_side(link)
    (low, high) = _panel(link)
    edge = (low if m > 0 else high)[1]
    lack = FROM_EDGE_M - abs(edge - link.handle.pos[1])
    return m * lack if lack > 0.001 else 0.0


def _line(
    near: Array, side: Array, headings: Iterable[float], ways: tuple[float, ...], share: Array
) -> Array:
    """Base paths (N, K, 3): from points of a grid backwards along a heading, ``share`` (K,) of the way."""
    out = []
    for x, y, heading, way in product(near, side, headings, ways):
        back = np.array([np.cos(heading), np.sin(heading)]) * way
        out.append(
            np.c_[np.array([x, y]) + share[:, None] * back, np.full(len(share), np.pi + heading)]
        )
    return np.array(out)


def _in_reach(robot: Robot, base: Array, hands: Array) -> Array:
    """Base paths (N, K, 3) whose shoulder is at a workable distance of the hands (K, 3) all the way."""
    yaw = base[..., 2]
    shoulder_ahead = robot.reach.ahead + robot.reach.out
    nearest, farthest = robot.reach.level
    shoulder = base[..., :2] + shoulder_ahead * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    far = np.linalg.norm(shoulder - hands[None, :, :2], axis=-1)
    return (far.max(axis=1) < farthest) & (far.min(axis=1) > nearest)


def _panel(link: JointedLink) -> tuple[Array, Array]:
    """Least and greatest corner (3,) of the closed door without its bar and shelves."""
    boxes = link.boxes(0.0)
    k = int(np.argmax(boxes.half.prod(axis=1)))
    reach = np.abs(boxes.rot[k]) @ boxes.half[k]
    return boxes.center[k] - reach, boxes.center[k] + reach


def _carcass(link: JointedLink) -> Boxes:
    low, high = _panel(link)
    middle = np.array([low[0] - 0.006 - 0.31, (low[1] + high[1]) / 2, 0.975])
    return Boxes(middle[None], np.array([[0.31, (high[1] - low[1]) / 2, 0.975]]), np.eye(3)[None])


def _with_door(link: JointedLink, angle: float) -> Boxes:
    parts = (_carcass(link), link.boxes(max(angle, 0.0)))
    return Boxes.join(parts)


def _level(yaw: Array) -> Array:
    """Hands (K, 3, 3) that point level against the directions ``yaw`` (K,), fingers side by side."""
    forward = -np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], axis=-1)
    return stances.hand(forward, np.stack([-forward[:, 1], forward[:, 0], 0.0 * yaw], axis=-1))


@dataclass(frozen=True, eq=False)
class _HandPath:
    """Hand poses ``pos`` (K, 3), ``rot`` (K, 3, 3) in the plan frame at K angles (K,) of a door [rad]."""

    pos: Array
    rot: Array
    angles: Array


def _search(
    robot: Robot,
    link: JointedLink,
    base: Array,
    hands: _HandPath,
    tries: int,
    mode: ik.Mode = "pose",
) -> Stances:
    """Stances along one path of the hand, for those of the base paths (N, K, 3) from which the arm may reach it."""
    base = base[_in_reach(robot, base, hands.pos)]
    n = len(base)
    return stances.track(
        robot,
        base,
        np.broadcast_to(hands.pos, (n, *hands.pos.shape)),
        np.broadcast_to(hands.rot, (n, *hands.rot.shape)),
        [_with_door(link, float(a)) for a in hands.angles],
        tries=tries,
        mode=mode,
    )


def pull_stances(robot: Robot, link: JointedLink, further: float = 0.0) -> Stances:
    """Hand before the bar, on it, and along its arc. The hand turns less than the door: the pads let the bar turn."""
    angles = pull_angles(link, further)
    grip = np.array([link.handle_pose(max(a, 0.0))[0] for a in angles])
    grip[:, 2] += ABOVE_MIDDLE_M
    share = np.clip(angles / angles[-1], 0.0, 1.0)
    m = _hand_side(link)
    thick = link.handle.thickness > THICK_BAR_M
    headings = m * np.array([0.6, 0.9, 1.2, 1.5] if thick else [0.3, 0.6, 0.9])
    ways = (0.5, 0.65, 0.8, 0.95) if thick else (0.4, 0.6)
    base = _line(np.arange(0.8, 1.25, 0.1), m * np.arange(-0.85, 0.15, 0.15), headings, ways, share)
    found = []
    for first, last in ((0.0, 0.6), (0.0, 1.2), (0.15, 0.7)) if thick else ((0.4, 0.6), (0.8, 0.7)):
        yaw = m * (first + (last - first) * share)
        pos = grip.copy()
        pos[0] += PRE_GRASP_M * np.array([np.cos(yaw[0]), np.sin(yaw[0]), 0.0])
        found.append(_search(robot, link, base, _HandPath(pos, _level(yaw), angles), tries=5))
    return Stances.join(found)


def push_open(robot: Robot, link: JointedLink) -> Stances:
    """Ways to push a door shut from wherever it stands."""
    return _push_stances(robot, link, half=False)


def push_half_open(robot: Robot, link: JointedLink) -> Stances:
    """Ways to push a door shut that is not wide open."""
    return _push_stances(robot, link, half=True)


def _push_stances(robot: Robot, link: JointedLink, half: bool) -> Stances:
    """The closed fingers on the outside of the door above its bar, from behind the open door to the closed one."""
    angles = push_angles(link, half)
    share = np.clip(1.0 - angles / angles[0], 0.0, 1.0)
    ways = (-1.0, -0.8, -0.6, -0.4)
    m = _hand_side(link)
    headings = m * np.array([0.2, 0.45, 0.7, 0.95, 1.2])
    base = _line(np.arange(0.8, 1.7, 0.1), m * np.arange(-0.1, 1.25, 0.1), headings, ways, share)
    handle = link.handle
    face = _panel(link)[1][0]
    inward = _inward(link)
    found = []
    for first, last in PUSH_YAWS_RAD if half else PUSH_YAWS_RAD[1:]:
        yaw = first + (last - first) * share
        lag = angles - yaw
        gap = (
            face + TIP_M * np.abs(np.cos(lag)) + FINGER_SIDE_M * np.abs(np.sin(lag)) - handle.pos[0]
        )
        pos = []
        for angle, more in zip(angles, gap, strict=True):
            at, bar, out = link.handle_pose(float(angle))
            across = np.array([-out[1], out[0], 0.0])
            pos.append(at + more * out + inward * across + (handle.half_length + ABOVE_BAR_M) * bar)
        hands = _HandPath(np.array(pos), _level(m * yaw), angles)
        # Few stances reach behind a wide open door: a finer search there.
        tries = 5 if half else 8
        found.append(_search(robot, link, base, hands, tries=tries, mode="approach"))
    return Stances.join(found)
