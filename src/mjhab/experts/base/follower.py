"""Path following for a base with differential drive: base commands for every control step.

Lengths [m], angles [rad], speeds [m/s] and [rad/s], world frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mjhab.core.rotations import wrap
from mjhab.core.timing import STEP_SECONDS

Array = np.ndarray


@dataclass(frozen=True)
class DriveLimits:
    """Bounds and gains of `Follower`.

    The gains act on the pose expected ``preview`` seconds ahead, which compensates the base's time constant of about
    0.15 s.

    Attributes:
        speed: largest forward speed [m/s].
        turn_rate: largest yaw rate [rad/s].
        brake_gain: speed per distance to the end of the path [1/s].
        turn_gain: yaw rate per angle to the wanted heading [1/s].
        preview: see above [s].
        lookahead: arc length between the base and the point that it steers at [m].
        turn_first: angle to the wanted heading beyond which the base turns on the spot [rad].
        reverse_below: paths shorter than this may be driven backwards [m].
        pos_tolerance: distance to the goal at which the base has arrived [m].
        yaw_tolerance: angle to the final heading at which the base has arrived [rad].
    """

    speed: float = 0.8
    turn_rate: float = 2.4
    brake_gain: float = 3.0
    turn_gain: float = 4.5
    preview: float = 0.1
    lookahead: float = 0.18
    turn_first: float = 0.5
    reverse_below: float = 0.9
    pos_tolerance: float = 0.02
    yaw_tolerance: float = 0.03


class Drive(NamedTuple):
    """Commands of one control step.

    Attributes:
        v: forward speed [m/s].
        w: yaw rate [rad/s].
        done: whether the base stands still at its goal.
    """

    v: float
    w: float
    done: bool


class Follower:
    """Drives a base that cannot move sideways along way points, then turns it to a final heading.

    Args:
        path: (P, 2) way points; the first is where the base is.
        final_yaw: heading at the end; None leaves the heading of the arrival.
        limits: speeds, gains, tolerances.
        direction: 1 forwards, -1 backwards, 0 chosen from the first pose: backwards only on paths shorter than
            ``limits.reverse_below`` and when that takes less turning.
    """

    def __init__(
        self,
        path: Array,
        final_yaw: float | None = None,
        limits: DriveLimits | None = None,
        direction: int = 0,
    ) -> None:
        self.path = np.asarray(path, dtype=np.float64)[:, :2]
        self.final_yaw = final_yaw
        self.limits = limits or DriveLimits()
        self.direction = direction
        legs = np.linalg.norm(np.diff(self.path, axis=0), axis=1)
        self._along = np.concatenate([[0.0], np.cumsum(legs)])
        self._done_to = 0.0
        self._turning = False
        self._arrived = False
        self._last: Array | None = None
        self._speed = self._rate = 0.0

    @property
    def length(self) -> float:
        """Length of the path [m]."""
        return float(self._along[-1])

    def step(self, pose: Array) -> Drive:
        """Commands for the base at ``pose`` (3,): x, y, yaw. Call once per control step."""
        pose = np.asarray(pose, dtype=np.float64)
        motion = np.zeros(3) if self._last is None else wrap_pose(pose - self._last)
        moved = np.inf if self._last is None else float(np.abs(motion).max())
        self._last = pose
        along = np.cos(pose[2]) * motion[0] + np.sin(pose[2]) * motion[1]
        self._speed = float(along) / STEP_SECONDS
        self._rate = float(motion[2]) / STEP_SECONDS
        if self.direction == 0:
            self.direction = self._choose_direction(pose)
        to_goal = self.path[-1] - pose[:2]
        gap = float(np.linalg.norm(to_goal))
        turn = 0.0 if self.final_yaw is None else float(wrap(self.final_yaw - pose[2]))
        stuck = moved < 0.1 * STEP_SECONDS and abs(turn) < self.limits.yaw_tolerance
        if self._arrived and gap > (1.0 if stuck else 2.0) * self.limits.pos_tolerance:
            self._arrived = False
            self._done_to = self.length
            self.direction = 1 if self._ahead(pose) >= 0 else -1
        else:
            self._arrived = (
                self._arrived or gap < 0.5 * self.limits.pos_tolerance or self._beside(pose, gap)
            )
        if not self._arrived:
            return self._approach(pose, gap)
        done = bool(stuck and gap < self.limits.pos_tolerance)
        return Drive(self._creep(pose), self._turn_rate(turn), done)

    def _creep(self, pose: Array) -> float:
        """Forward speed that removes the remaining error along the heading while the base turns on the spot."""
        left = self._ahead(pose) - self.limits.preview * self._speed
        return float(np.clip(2.0 * left, -0.2, 0.2)) if abs(left) > 0.003 else 0.0

    def _approach(self, pose: Array, gap: float) -> Drive:
        limits = self.limits
        left = max(self.length - self._advance(pose[:2]), 0.0)
        target = self._point(self.length - left + limits.lookahead)
        bearing = np.arctan2(*(target - pose[:2])[::-1])
        back = np.pi if self.direction < 0 else 0.0
        off = float(wrap(bearing - pose[2] - back))
        if gap < 0.06 and left < 0.06 and abs(off) > 0.5 * np.pi:
            self.direction = -self.direction  # overshot a little: come back without turning round
            off = float(wrap(off + np.pi))
        self._turning = abs(off) > (0.12 if self._turning else limits.turn_first)
        if self._turning and gap > limits.pos_tolerance:
            return Drive(0.0, self._turn_rate(off), False)
        straight = max(0.0, np.cos(off)) ** 3
        room = max(max(left, gap) - limits.preview * abs(self._speed), 0.0)
        speed = min(limits.speed, limits.brake_gain * room, 0.25 + 1.2 * self._to_corner(left))
        fade = min(1.0, gap / 0.08)  # the bearing to a very near point says little
        return Drive(self.direction * speed * straight, fade * self._turn_rate(off), False)

    def _turn_rate(self, angle: float) -> float:
        limits = self.limits
        rate = limits.turn_gain * (angle - limits.preview * self._rate)
        return float(np.clip(rate, -limits.turn_rate, limits.turn_rate))

    def _advance(self, point: Array) -> float:
        """Arc length of the base's projection onto the path; it never decreases."""
        for i in range(len(self.path) - 1):
            start = self.path[i]
            leg = self.path[i + 1] - self.path[i]
            size = float(leg @ leg)
            share = float(np.clip((point - start) @ leg / size, 0.0, 1.0)) if size > 0 else 0.0
            at = self._along[i] + share * np.sqrt(size)
            near = np.linalg.norm(start + share * leg - point) < 0.3
            if self._done_to < at < self._done_to + 0.5 and near:
                self._done_to = at
        return self._done_to

    def _point(self, at: float) -> Array:
        at = float(np.clip(at, 0.0, self.length))
        return np.array([np.interp(at, self._along, self.path[:, k]) for k in range(2)])

    def _to_corner(self, left: float) -> float:
        """Arc length to the next inner way point, before which the base slows down."""
        ahead = self._along[1:-1] - (self.length - left)
        ahead = ahead[ahead > -0.05]
        return float(max(ahead[0], 0.0)) if len(ahead) else np.inf

    def _ahead(self, pose: Array) -> float:
        to_goal = self.path[-1] - pose[:2]
        return float(np.cos(pose[2]) * to_goal[0] + np.sin(pose[2]) * to_goal[1])

    def _beside(self, pose: Array, gap: float) -> bool:
        """Whether the goal is within tolerance beside the base, where driving on does not reduce the distance."""
        return (
            gap < self.limits.pos_tolerance
            and abs(self._ahead(pose)) < 0.3 * self.limits.pos_tolerance
        )

    def _choose_direction(self, pose: Array) -> int:
        if self.length > self.limits.reverse_below:
            return 1
        first = self._point(self.limits.lookahead) - pose[:2]
        last = self.path[-1] - (self.path[-2] if len(self.path) > 1 else pose[:2])
        turn = abs(wrap(np.arctan2(first[1], first[0]) - pose[2]))
        leave = (
            0.0
            if self.final_yaw is None
            else abs(wrap(self.final_yaw - np.arctan2(last[1], last[0])))
        )
        back = (np.pi - turn) + (0.0 if self.final_yaw is None else np.pi - leave)
        return -1 if back < turn + leave - 0.3 else 1


def wrap_pose(delta: Array) -> Array:
    """Differences of poses (..., 3) with the angle in [-pi, pi)."""
    return np.concatenate([delta[..., :2], wrap(delta[..., 2:])], axis=-1)
