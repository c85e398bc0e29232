"""Compiled path following for the base, and a simulation of it that predicts the base poses.

A path is a sequence of segments: each is driven forwards or backwards and ends with a turn on the spot. Lengths [m],
angles [rad], world frame. Letters: P way points, S segments, T control steps.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mjhab.core.rotations import wrap
from mjhab.core.timing import STEP_SECONDS
from mjhab.experts.base.limits import MAX_YAW_RATE_RAD_S, UNLIMITED, CommandLimits, eased
from mjhab.experts.jit import inline, kernel

SPEED_LAG_S = 0.15
"""Time constant with which the speed of the base follows its command. With it and `YAW_LAG_S` a simulated bend ends
within 8 mm of the real one (tests/experts/planning/test_carrying.py drives one)."""
YAW_LAG_S = 0.02
"""The same for the yaw rate, which has much less inertia."""
MAX_SIMULATED_STEPS = 200
"""Control steps after which the simulation of a segment gives up: the horizon of a subtask."""
TURN_END_RATE_RAD_S = 0.5
"""Yaw rate below which the turn between two segments counts as done; it is commanded 0.1 rad before the end."""
SLOWEST_M_S = 0.2
SPARE_STEPS = 60
"""A segment is given up after the control steps of its length at `SLOWEST_M_S`, and `SPARE_STEPS` for its turns."""
STEERING_GAIN = 4.5
"""Yaw rate per angle to the aim [1/s]."""
BRAKING_GAIN = 3.0
"""Forward speed per distance that is left [1/s]."""
PREVIEW_S = 0.1
"""Time by which the motion of the base is extrapolated before it steers: two control steps."""
MIN_SPEED_M_S = 0.04
"""Speed with which the base creeps over the last centimetres."""
MIN_LOOKAHEAD_M = 0.10
"""Shortest distance to the aim, near the end of a segment."""
TURN_FIRST_RAD = 0.9
"""Angle to the aim above which the base turns on the spot."""
ARRIVED_M = 0.02
"""Distance to the end of a segment at which the base only turns."""
BESIDE_M = 0.12
"""The same for an end at the side of the base: the arm compensates centimetres faster than the base turns."""
TURNED_RAD = 0.05
STILL_RAD_S = 0.4
STILL_M = 0.006
"""Angle to the heading at the end, yaw rate, and motion per control step with which a segment ends: the arm compensates
less."""
ENDING_M = 0.25
"""Length of the last part of a segment that gives the direction of its end."""
PROGRESS_REACH_M = 0.3
PROGRESS_STEP_M = 0.01
"""Range of arc length beyond the last projection, and its resolution, in which the next projection is searched: a base
at 1 m/s moves 0.05 m per control step."""
MAX_TURN_RAD = 2.2
"""Largest turn of one segment, well below the pi from which on the shorter turn is the other one."""

_ARC, _AT_END, _X, _Y, _YAW, _SEEN, _SEGMENT, _LEFT, _FORWARD, _TURN = range(10)
"""State of a follower: arc length in the segment, is its end reached (0, 1), the last pose, is there one (0, 1), index
of the segment, control steps left for it, and the last commands [m/s, rad/s]."""


@dataclass(frozen=True, eq=False)
class PathSegment:
    """A piece of a path.

    Attributes:
        points: (P, 2) way points; the first is where the base is.
        direction: 1 forwards, -1 backwards.
        yaw: heading at the end, to which the base turns on the spot.
    """

    points: np.ndarray
    direction: int
    yaw: float

    @property
    def length(self) -> float:
        """Length of the segment [m], 0 for a turn on the spot."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


@dataclass(frozen=True, eq=False)
class BaseTrajectory:
    """A planned drive.

    Attributes:
        segments: pieces of the path, in order.
        lookahead: arc length between the base and the point that it steers at [m].
        limits: limits on the commands.
        poses: (T, 3) simulated base poses x, y, yaw, one per control step; the first is the present one.
    """

    segments: Sequence[PathSegment]
    lookahead: float
    limits: CommandLimits
    poses: np.ndarray

    @classmethod
    def of(
        cls,
        pose: np.ndarray,
        segments: Sequence[PathSegment],
        lookahead: float,
        limits: CommandLimits = UNLIMITED,
    ) -> BaseTrajectory:
        """Simulate the drive along ``segments`` from base pose ``pose`` (3,)."""
        return cls(
            segments, lookahead, limits, simulate(pose, segments, lookahead, limits)
        )


class Follower:
    """Controller that drives the base along segments, one after the other.

    It ends within centimetres of the goal; the arm compensates the rest.

    Args:
        segments: pieces of the path, in order.
        lookahead: arc length between the base and the point that it steers at [m].
        limits: limits on the commands.
        now: present forward speed [m/s] and yaw rate [rad/s] of the base.
    """

    def __init__(
        self,
        segments: Sequence[PathSegment],
        lookahead: float,
        limits: CommandLimits = UNLIMITED,
        now: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self._segments = segments
        self._limits = limits
        self._track = _track(segments, lookahead)
        self._state = _fresh_state(self._track)
        self._state[_FORWARD], self._state[_TURN] = now

    @property
    def segment(self) -> PathSegment | None:
        """The present segment; None at the end."""
        at = int(self._state[_SEGMENT])
        return self._segments[at] if at < len(self._segments) else None

    @property
    def arrived(self) -> bool:
        """Whether the base is at the end of the path, or has given it up."""
        return self._state[_SEGMENT] >= len(self._segments)

    def step(
        self, pose: np.ndarray, now: tuple[float, float] | None = None
    ) -> tuple[float, float]:
        """Forward speed [m/s] and yaw rate [rad/s] for the base at ``pose`` (3,). Call once per control step.

        ``now``: present speeds of the base, to which the limits refer; the last commands if not given.
        """
        if now is not None:
            self._state[_FORWARD], self._state[_TURN] = now
        x, y, yaw = (float(value) for value in pose[:3])
        return _command(self._track, self._limits, self._state, x, y, yaw)


def simulate(
    pose: np.ndarray,
    segments: Sequence[PathSegment],
    lookahead: float,
    limits: CommandLimits = UNLIMITED,
) -> np.ndarray:
    """Simulate the base poses (T, 3) of a `Follower`, one per control step; the first is ``pose`` (3,)."""
    track = _track(segments, lookahead)
    start = np.array(pose[:3], dtype=np.float64)
    return _drive(track, limits, _fresh_state(track), start)


def turns(xy: np.ndarray, start: float, turn: float) -> list[PathSegment]:
    """Segments that turn on the spot at ``xy`` (2,) by a signed angle from heading ``start``.

    Each turns by less than pi, because a segment gives only its final heading and the base takes the shorter turn.
    """
    if abs(turn) < 1e-6:
        return []
    pieces = 1 + int(abs(turn) / MAX_TURN_RAD)
    yaws = [float(wrap(start + turn * (k + 1) / pieces)) for k in range(pieces)]
    return [PathSegment(np.stack([xy, xy]), 1, yaw) for yaw in yaws]


class PackedPath(NamedTuple):
    """Segments for the kernels.

    Attributes:
        points: (P, 2) way points of all segments.
        along: (P,) arc length at the way points, from 0 in every segment.
        first: (S + 1,) index of the first way point of each segment, and of the end.
        ending: (S, 2) unit vectors of the directions at the ends.
        yaw: (S,) headings at the ends.
        direction: (S,) 1 forwards, -1 backwards.
        budget: (S,) control steps after which a segment is given up.
        lookahead: arc length between the base and the point that it steers at.
    """

    points: np.ndarray
    along: np.ndarray
    first: np.ndarray
    ending: np.ndarray
    yaw: np.ndarray
    direction: np.ndarray
    budget: np.ndarray
    lookahead: float


def _track(segments: Sequence[PathSegment], lookahead: float) -> PackedPath:
    points = [np.asarray(segment.points, dtype=np.float64) for segment in segments]
    along = []
    ending = np.zeros((len(points), 2))
    for row, path in zip(ending, points, strict=True):
        lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
        arc = np.concatenate([[0.0], np.cumsum(lengths)])
        row[:] = path[-1] - [
            np.interp(arc[-1] - ENDING_M, arc, path[:, k]) for k in range(2)
        ]
        # A turn on the spot has no direction.
        row /= max(float(np.linalg.norm(row)), 1e-9)
        along.append(arc)
    length = np.array([arc[-1] for arc in along])
    return PackedPath(
        # numpy joins no empty list.
        np.concatenate([*points, np.zeros((0, 2))]),
        np.concatenate([*along, np.zeros(0)]),
        np.cumsum([0, *map(len, points)]).astype(np.int64),
        ending,
        np.array([segment.yaw for segment in segments], dtype=np.float64),
        np.array([segment.direction for segment in segments], dtype=np.float64),
        SPARE_STEPS + (length / (SLOWEST_M_S * STEP_SECONDS)).astype(np.int64),
        float(lookahead),
    )


def _fresh_state(track: PackedPath) -> np.ndarray:
    """State (10,) of a follower before its first step."""
    state = np.zeros(10)
    _begin(track, state, 0)
    return state


@kernel
def _begin(track: PackedPath, state: np.ndarray, s: int) -> None:
    """Write into ``state`` (10,) that segment ``s`` begins."""
    state[_ARC] = 0.0
    state[_AT_END] = 0.0
    # The rate at the end of the segment before says nothing about this one.
    state[_SEEN] = 0.0
    state[_SEGMENT] = s
    if s < len(track.yaw):
        # A turn on the spot is at its end from the start.
        state[_AT_END] = track.along[track.first[s + 1] - 1] < ARRIVED_M
        state[_LEFT] = track.budget[s]


@inline
def _wrapped(angle: float) -> float:
    return (angle + np.pi) % (2 * np.pi) - np.pi


@inline
def _clipped(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@inline
def _point(track: PackedPath, s: int, at: float) -> tuple[float, float]:
    """Point at arc length ``at``; beyond the end on the straight extension, so that the heading settles before it."""
    last = track.first[s + 1] - 1
    over = at - track.along[last]
    if over >= 0.0:
        x = track.points[last, 0] + over * track.ending[s, 0]
        return x, track.points[last, 1] + over * track.ending[s, 1]
    k = track.first[s]
    while track.along[k + 1] <= at:
        k += 1
    share = max(at - track.along[k], 0.0) / (track.along[k + 1] - track.along[k])
    x = track.points[k, 0] + share * (track.points[k + 1, 0] - track.points[k, 0])
    return x, track.points[k, 1] + share * (track.points[k + 1, 1] - track.points[k, 1])


@inline
def _progress(track: PackedPath, s: int, at: float, x: float, y: float) -> float:
    """Arc length of the point of segment ``s`` nearest to (x, y), searched from arc length ``at`` forwards."""
    length = track.along[track.first[s + 1] - 1]
    # Forwards alone and not far: a path that comes back near itself must not be cut short.
    reach = min(at + PROGRESS_REACH_M, length) + 1e-9 - at
    best = at
    nearest = np.inf
    for k in range(int(np.ceil(reach / PROGRESS_STEP_M))):
        place = at + k * PROGRESS_STEP_M
        px, py = _point(track, s, min(place, length))
        gap = (px - x) ** 2 + (py - y) ** 2
        # The first of equals, which is the least progress.
        if gap < nearest:
            nearest = gap
            best = place
    return best


@inline
def _steer(
    track: PackedPath, speed: float, state: np.ndarray, x: float, y: float, yaw: float
) -> tuple[float, float, bool]:
    """Forward speed [m/s] up to ``speed``, yaw rate [rad/s] and arrival in the present segment; updates ``state``."""
    s = int(state[_SEGMENT])
    dx = 0.0
    dy = 0.0
    rate = 0.0
    if state[_SEEN] > 0.0:
        dx = x - state[_X]
        dy = y - state[_Y]
        rate = _wrapped(yaw - state[_YAW]) / STEP_SECONDS
    state[_X] = x
    state[_Y] = y
    state[_YAW] = yaw
    state[_SEEN] = 1.0
    moved = np.sqrt(dx * dx + dy * dy)
    last = track.first[s + 1] - 1
    left = 0.0
    if state[_AT_END] == 0.0:
        state[_ARC] = _progress(track, s, state[_ARC], x, y)
        left = track.along[last] - state[_ARC]
        gap_x = track.points[last, 0] - x
        gap_y = track.points[last, 1] - y
        near = np.sqrt(gap_x * gap_x + gap_y * gap_y)
        to_end = track.direction[s] * (gap_x * np.cos(yaw) + gap_y * np.sin(yaw))
        # An end at the side cannot be driven to, and the base would circle round it.
        if left < ARRIVED_M or (near < BESIDE_M and to_end < 0.5 * near):
            state[_AT_END] = 1.0
    if state[_AT_END] > 0.0:
        off = _wrapped(track.yaw[s] - yaw)
        still = abs(rate) < STILL_RAD_S and moved < STILL_M
        turn = STEERING_GAIN * (off - PREVIEW_S * rate)
        return 0.0, turn, abs(off) < TURNED_RAD and still
    # Shorter near the end, where the heading has to be right.
    lookahead = min(max(0.8 * left, MIN_LOOKAHEAD_M), track.lookahead)
    aim_x, aim_y = _point(track, s, state[_ARC] + lookahead)
    back = 0.0 if track.direction[s] > 0 else np.pi
    off = _wrapped(np.arctan2(aim_y - y, aim_x - x) - yaw - back)
    braking = BRAKING_GAIN * (left - PREVIEW_S * moved / STEP_SECONDS)
    pace = max(min(speed, braking), MIN_SPEED_M_S)
    ahead = 0.0 if abs(off) > TURN_FIRST_RAD else max(np.cos(off), 0.0) ** 3
    return (
        track.direction[s] * pace * ahead,
        STEERING_GAIN * (off - PREVIEW_S * rate),
        False,
    )


@kernel
def _command(
    track: PackedPath,
    limits: CommandLimits,
    state: np.ndarray,
    x: float,
    y: float,
    yaw: float,
) -> tuple[float, float]:
    """Forward speed [m/s] and yaw rate [rad/s] of one control step; updates ``state`` (10,)."""
    segments = len(track.yaw)
    forward = 0.0
    turn = 0.0
    while state[_SEGMENT] < segments:
        forward, turn, done = _steer(track, limits.speed, state, x, y, yaw)
        turn = _clipped(turn, -MAX_YAW_RATE_RAD_S, MAX_YAW_RATE_RAD_S)
        # A base that is blocked must not wait for ever.
        state[_LEFT] -= 1.0
        # Only the last segment has to end exactly: the others pass on to the next when their turn is nearly done.
        passes = state[_SEGMENT] < segments - 1 and forward == 0.0
        done = done or (passes and abs(turn) < TURN_END_RATE_RAD_S)
        if not done and state[_LEFT] >= 0.0:
            break
        _begin(track, state, int(state[_SEGMENT]) + 1)
        forward = 0.0
        turn = 0.0
    before = (state[_FORWARD], state[_TURN])
    forward, turn = eased((forward, limits.turn * turn), before, limits)
    state[_FORWARD] = forward
    state[_TURN] = turn
    return forward, turn


@kernel
def _drive(
    track: PackedPath, limits: CommandLimits, state: np.ndarray, pose: np.ndarray
) -> np.ndarray:
    """Base poses (T, 3) of `simulate`; the first is ``pose`` (3,)."""
    steps = MAX_SIMULATED_STEPS * len(track.yaw)
    poses = np.empty((steps + 1, 3))
    poses[0] = pose
    speed_share = 1.0 - np.exp(-STEP_SECONDS / SPEED_LAG_S)
    turn_share = 1.0 - np.exp(-STEP_SECONDS / YAW_LAG_S)
    speed_x = 0.0
    speed_y = 0.0
    turn = 0.0
    for k in range(steps):
        x = poses[k, 0]
        y = poses[k, 1]
        yaw = poses[k, 2]
        forward, rate = _command(track, limits, state, x, y, yaw)
        if state[_SEGMENT] >= len(track.yaw):
            return poses[: k + 1]
        # The base is driven along the two world axes with a lag: in a bend it keeps sliding along its former heading.
        speed_x += speed_share * (forward * np.cos(yaw) - speed_x)
        speed_y += speed_share * (forward * np.sin(yaw) - speed_y)
        turn += turn_share * (rate - turn)
        poses[k + 1, 0] = x + STEP_SECONDS * speed_x
        poses[k + 1, 1] = y + STEP_SECONDS * speed_y
        poses[k + 1, 2] = yaw + STEP_SECONDS * turn
    return poses
