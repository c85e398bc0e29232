"""Compiled path following for the base, and a simulation of it that predicts the base poses.

Lengths [m], angles [rad], world frame. Letters: P way points, T control steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.core.timing import STEP_SECONDS
from mjhab.experts.arm.gentle import CommandLimits, eased
from mjhab.experts.jit import inline, kernel

MAX_SPEED_M_S = 1.0
"""Greatest forward speed."""
SPEED_LAG_S = 0.15
"""Time constant with which the speed of the base follows its command."""
YAW_LAG_S = 0.02
"""Time constant with which the yaw rate of the base follows its command."""
MAX_SIMULATED_STEPS = 200
_TURN_RATE = 2.6
_PREVIEW = 0.1
_NEAR = 0.02
_TURNED = 0.05
_ENDING = 0.25
"""Length of the last part of the path that gives the direction of its end."""
_PROGRESS_REACH = 0.3
_PROGRESS_STEP = 0.01
"""Range of arc length beyond the last projection, and its resolution, in which the next projection is searched."""


class Way(NamedTuple):
    """A path for the kernels.

    Attributes:
        path: (P, 2) way points.
        along: (P,) arc length at the way points.
        ending: (2,) unit vector of the direction at the end.
        yaw: heading at the end.
        direction: 1 forwards, -1 backwards.
        lookahead: arc length between the base and the point that it steers at.
        speed: largest forward speed [m/s].
    """

    path: np.ndarray
    along: np.ndarray
    ending: np.ndarray
    yaw: float
    direction: float
    lookahead: float
    speed: float


class Pilot:
    """Controller that drives the base along a path, then turns it to a heading.

    It ends within centimetres of the goal; the arm compensates the rest.

    Args:
        path: (P, 2) way points; the first is where the base is.
        yaw: heading at the end.
        direction: 1 forwards, -1 backwards.
        lookahead: arc length between the base and the point that it steers at.
        speed: largest forward speed [m/s].
    """

    def __init__(
        self,
        path: np.ndarray,
        yaw: float,
        direction: int,
        lookahead: float,
        speed: float = MAX_SPEED_M_S,
    ) -> None:
        self._way = _way_along(path, yaw, direction, lookahead, speed)
        self._state = _fresh_state(self._way)

    def step(self, pose: np.ndarray) -> tuple[float, float, bool]:
        """Forward speed [m/s], yaw rate [rad/s] and whether the base has arrived, for the base at ``pose`` (3,).

        Call once per control step.
        """
        return _steer(
            self._way, self._state, float(pose[0]), float(pose[1]), float(pose[2])
        )


def simulate(
    pose: np.ndarray,
    path: np.ndarray,
    yaw: float,
    direction: int,
    lookahead: float,
    limits: CommandLimits | None = None,
) -> np.ndarray:
    """Simulate the base poses (T, 3) of a `Pilot` from ``pose`` (3,) on, one per control step.

    Args:
        pose: (3,) present base pose x, y, yaw.
        path: (P, 2) way points.
        yaw: heading at the end.
        direction: 1 forwards, -1 backwards.
        lookahead: arc length between the base and the point that it steers at.
        limits: limits on changes of the commands; None for none.
    """
    way = _way_along(path, yaw, direction, lookahead, MAX_SPEED_M_S)
    start = np.array(pose[:3], dtype=np.float64)
    return _drive(way, _fresh_state(way), start, limits or _NO_CARE, limits is not None)


_NO_CARE = CommandLimits(np.inf, np.inf, np.inf, np.inf)


def _way_along(
    path: np.ndarray, yaw: float, direction: int, lookahead: float, speed: float
) -> Way:
    path = np.ascontiguousarray(path, dtype=np.float64)
    segments = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(segments)])
    ending = path[-1] - [
        np.interp(along[-1] - _ENDING, along, path[:, k]) for k in range(2)
    ]
    ending = ending / max(float(np.linalg.norm(ending)), 1e-9)
    return Way(
        path, along, ending, float(yaw), float(direction), float(lookahead), float(speed)
    )


def _fresh_state(way: Way) -> np.ndarray:
    """State (6,) of `_steer` before its first step: arc length, arrived (0, 1), last pose (3,), is there one (0, 1)."""
    state = np.zeros(6)
    state[1] = way.along[-1] < _NEAR
    return state


@inline
def _wrapped(angle: float) -> float:
    return (angle + np.pi) % (2 * np.pi) - np.pi


@inline
def _clipped(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@inline
def _point(way: Way, at: float) -> tuple[float, float]:
    """Point at arc length ``at``; beyond the end on the straight extension, so that the heading settles before it."""
    last = len(way.along) - 1
    over = at - way.along[last]
    if over >= 0.0:
        x = way.path[last, 0] + over * way.ending[0]
        return x, way.path[last, 1] + over * way.ending[1]
    k = 0
    while way.along[k + 1] <= at:
        k += 1
    share = max(at - way.along[k], 0.0) / (way.along[k + 1] - way.along[k])
    x = way.path[k, 0] + share * (way.path[k + 1, 0] - way.path[k, 0])
    return x, way.path[k, 1] + share * (way.path[k + 1, 1] - way.path[k, 1])


@inline
def _progress(way: Way, at: float, x: float, y: float) -> float:
    """Arc length of the point of the path nearest to (x, y), searched from arc length ``at`` forwards."""
    length = way.along[len(way.along) - 1]
    count = int(np.ceil((min(at + _PROGRESS_REACH, length) + 1e-9 - at) / _PROGRESS_STEP))
    best = at
    nearest = np.inf
    for k in range(count):
        place = at + k * _PROGRESS_STEP
        px, py = _point(way, min(place, length))
        gap = (px - x) ** 2 + (py - y) ** 2
        if gap < nearest:
            nearest = gap
            best = place
    return best


@kernel
def _steer(
    way: Way, state: np.ndarray, x: float, y: float, yaw: float
) -> tuple[float, float, bool]:
    """Forward speed [m/s], yaw rate [rad/s] and arrival of one control step; updates ``state`` (6,)."""
    dx = 0.0
    dy = 0.0
    rate = 0.0
    if state[5] > 0.0:
        dx = x - state[2]
        dy = y - state[3]
        rate = _wrapped(yaw - state[4]) / STEP_SECONDS
    state[2] = x
    state[3] = y
    state[4] = yaw
    state[5] = 1.0
    moved = np.sqrt(dx * dx + dy * dy)
    last = len(way.along) - 1
    left = 0.0
    if state[1] == 0.0:
        state[0] = _progress(way, state[0], x, y)
        left = way.along[last] - state[0]
        gap_x = way.path[last, 0] - x
        gap_y = way.path[last, 1] - y
        near = np.sqrt(gap_x * gap_x + gap_y * gap_y)
        to_end = way.direction * (gap_x * np.cos(yaw) + gap_y * np.sin(yaw))
        # A goal at the side of the base counts as reached: the arm compensates centimetres faster than the base turns.
        if left < _NEAR or (near < 0.12 and to_end < 0.5 * near):
            state[1] = 1.0
    if state[1] > 0.0:
        turn = _wrapped(way.yaw - yaw)
        still = abs(turn) < _TURNED and abs(rate) < 0.4 and moved < 0.006
        return (
            0.0,
            _clipped(4.5 * (turn - _PREVIEW * rate), -_TURN_RATE, _TURN_RATE),
            still,
        )
    lookahead = min(max(0.8 * left, 0.10), way.lookahead)
    aim_x, aim_y = _point(way, state[0] + lookahead)
    back = 0.0 if way.direction > 0 else np.pi
    off = _wrapped(np.arctan2(aim_y - y, aim_x - x) - yaw - back)
    pace = max(min(way.speed, 3.0 * (left - _PREVIEW * moved / STEP_SECONDS)), 0.04)
    ahead = 0.0 if abs(off) > 0.9 else max(np.cos(off), 0.0) ** 3
    turn_rate = _clipped(4.5 * (off - _PREVIEW * rate), -_TURN_RATE, _TURN_RATE)
    return way.direction * pace * ahead, turn_rate, False


@kernel
def _drive(
    way: Way, state: np.ndarray, pose: np.ndarray, limits: CommandLimits, careful: bool
) -> np.ndarray:
    """Base poses (T, 3) of `simulate`; the first is ``pose`` (3,)."""
    poses = np.empty((MAX_SIMULATED_STEPS + 1, 3))
    poses[0] = pose
    speed_share = 1.0 - np.exp(-STEP_SECONDS / SPEED_LAG_S)
    turn_share = 1.0 - np.exp(-STEP_SECONDS / YAW_LAG_S)
    speed_x = 0.0
    speed_y = 0.0
    turn = 0.0
    asked = (0.0, 0.0)
    for k in range(MAX_SIMULATED_STEPS):
        x = poses[k, 0]
        y = poses[k, 1]
        yaw = poses[k, 2]
        forward, rate, done = _steer(way, state, x, y, yaw)
        if done:
            return poses[: k + 1]
        if careful:
            asked = eased((forward, rate), asked, limits)
            forward, rate = asked
        # The base is driven along the two world axes with a lag: in a bend it keeps sliding along its former heading.
        speed_x += speed_share * (forward * np.cos(yaw) - speed_x)
        speed_y += speed_share * (forward * np.sin(yaw) - speed_y)
        turn += turn_share * (rate - turn)
        poses[k + 1, 0] = x + STEP_SECONDS * speed_x
        poses[k + 1, 1] = y + STEP_SECONDS * speed_y
        poses[k + 1, 2] = yaw + STEP_SECONDS * turn
    return poses
