"""Driving along a path of segments: base commands, the choice of curves or turns on the spot, simulated base poses.

Lengths [m], angles [rad], world frame. Letters: T control steps, P points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mjhab.core.rotations import wrap
from mjhab.core.timing import STEP_SECONDS
from mjhab.experts.base.floorplan import Floorplan, turn_between
from mjhab.experts.base.lattice import PathSegment, length
from mjhab.experts.base.pilot import SPEED_LAG_S, Pilot

WANTED_CLEARANCE_M = 0.02
"""Clearance that a drive should keep beyond the least one."""
CLOSENESS_PRICE_S_M2 = 5000.0
"""Cost of a drive with less clearance, per square of the missing clearance [s/m2]."""
AMPLE_CLEARANCE_M = 0.08
"""Clearance of a straight line with which it may replace way points that have more."""
TURN_END_RATE_RAD_S = 0.5
"""Yaw rate below which a turn between two segments counts as done; `Pilot` commands it 0.1 rad before the end."""
MAX_SPLITS = 8
"""Greatest number of curves that are replaced by turns on the spot for lack of clearance."""
MAX_CURVE_RAD = 2.0
"""Turns up to this are driven as curves, not on the spot."""


@dataclass(frozen=True)
class Pace:
    """Limits on the base commands.

    Attributes:
        speed: largest forward speed [m/s].
        rise: largest acceleration [m/s2]; deceleration may be twice as large.
        turn: factor on the yaw rate that `Pilot` commands.
        spin: largest yaw rate [rad/s].
        jerk: largest change of the yaw rate [rad/s2].
    """

    speed: float = 1.0
    rise: float = 20.0
    turn: float = 1.0
    spin: float = 2.6
    jerk: float = 80.0


BRISK = Pace()
GENTLE = Pace(0.7, 1.5, 0.5, 1.2, 3.0)
"""`BRISK` is for an empty hand, `GENTLE` for a held object that must not slip."""


@dataclass(frozen=True, eq=False)
class BaseTrajectory:
    """A planned drive.

    Attributes:
        segments: pieces of the path, in order.
        lookahead: look-ahead distance of `Pilot` [m].
        pace: limits on the commands.
        poses: (T, 3) simulated base poses x, y, yaw, one per control step.
    """

    segments: Sequence[PathSegment]
    lookahead: float
    pace: Pace
    poses: np.ndarray


class Driver:
    """Controller that drives segments one after the other; ``segment`` is the present one, None at the end.

    Args:
        segments: pieces of the path.
        lookahead: look-ahead distance of `Pilot` [m].
        pace: limits on the commands.
        v: present forward speed of the base [m/s].
        w: present yaw rate of the base [rad/s].
    """

    def __init__(
        self,
        segments: Sequence[PathSegment],
        lookahead: float,
        pace: Pace,
        v: float = 0.0,
        w: float = 0.0,
    ) -> None:
        self._segments = list(segments)
        self._lookahead = lookahead
        self._pace = pace
        self._v = v
        self._w = w
        self.segment: PathSegment | None = None
        self._begin()

    def _begin(self) -> None:
        self.segment = segment = self._segments.pop(0) if self._segments else None
        if segment is not None:
            self._pilot = Pilot(
                segment.points,
                segment.yaw,
                segment.direction,
                self._lookahead,
                self._pace.speed,
            )
            self._left = 60 + int(length(segment) / (0.2 * STEP_SECONDS))

    def step(self, pose: np.ndarray) -> tuple[float, float]:
        """Forward speed [m/s] and yaw rate [rad/s] for the base at ``pose`` (3,). Call once per control step."""
        v = w = 0.0
        while self.segment is not None:
            v, w, done = self._pilot.step(pose)
            self._left -= 1
            # Only the last segment has to end exactly: the others pass on to the next when their turn is nearly done.
            done = done or (
                bool(self._segments) and v == 0.0 and abs(w) < TURN_END_RATE_RAD_S
            )
            if not done and self._left >= 0:
                break
            self._begin()
            v = w = 0.0
        pace = self._pace
        gain = pace.rise * STEP_SECONDS
        change = pace.jerk * STEP_SECONDS
        self._v = towards(v, self._v, gain)
        w = float(np.clip(pace.turn * w, -pace.spin, pace.spin))
        self._w = float(np.clip(w, self._w - change, self._w + change))
        return self._v, self._w


def towards(wish: float, now: float, gain: float) -> float:
    """Speed ``now`` moved towards ``wish``: by at most ``gain`` where its magnitude grows, else twice that."""
    up, down = (gain, 2.0 * gain) if now >= 0.0 else (2.0 * gain, gain)
    return float(np.clip(wish, now - down, now + up))


def plan_drive(
    plan: Floorplan, pose: np.ndarray, segments: Sequence[PathSegment], pace: Pace
) -> BaseTrajectory:
    """Plan the quickest drive along segments that keeps about the clearance that the segments have.

    The drive uses curves, and turns on the spot where a curve comes too close to an obstacle.

    Args:
        plan: free space.
        pose: (3,) present base pose x, y, yaw.
        segments: the path, with turns on the spot.
        pace: limits on the commands.
    """
    curves = _joined(segments)
    pulled = _pulled(plan, curves)
    asked = min(WANTED_CLEARANCE_M, float(plan.clearance(pose[None])[0]) - 0.03)
    best: tuple[float, BaseTrajectory] | None = None
    for choice, lookahead in (
        (pulled, 0.3),
        (pulled, 0.2),
        (curves, 0.2),
        (segments, 0.1),
    ):
        tried: Sequence[PathSegment] | None = choice
        for _ in range(MAX_SPLITS):
            trajectory = BaseTrajectory(
                tried, lookahead, pace, simulate(pose, tried, lookahead, pace)
            )
            clearance = plan.clearance(trajectory.poses)
            lack = max(asked - float(clearance.min(initial=np.inf)), 0.0)
            cost = STEP_SECONDS * len(trajectory.poses) + CLOSENESS_PRICE_S_M2 * lack**2
            if best is None or cost < best[0]:
                best = (cost, trajectory)
            if lack == 0.0:
                return best[1]
            tried = _split(tried, trajectory.poses[int(np.argmin(clearance)), :2])
            if tried is None:
                break
    assert best is not None
    return best[1]


def _split(segments: Sequence[PathSegment], near: np.ndarray) -> list[PathSegment] | None:
    """Segments with the way point nearest to ``near`` (2,) driven as a turn on the spot; None when none is left."""
    best: tuple[float, int, int] | None = None
    for i, segment in enumerate(segments):
        for k in range(1, len(segment.points) - 1):
            gap = float(np.linalg.norm(segment.points[k] - near))
            if best is None or gap < best[0]:
                best = (gap, i, k)
    if best is None:
        return None
    _, i, k = best
    segment = segments[i]
    offset = segment.points[k + 1] - segment.points[k]
    yaw = float(
        wrap(np.arctan2(offset[1], offset[0]) + (0.0 if segment.direction > 0 else np.pi))
    )
    parts = [
        PathSegment(segment.points[: k + 1], segment.direction, yaw),
        PathSegment(segment.points[k:], segment.direction, segment.yaw),
    ]
    return [*segments[:i], *parts, *segments[i + 1 :]]


def _joined(segments: Sequence[PathSegment]) -> list[PathSegment]:
    """Segments with consecutive ones in the same direction joined into one, if the turn between them is moderate."""
    out: list[PathSegment] = []
    pending: list[PathSegment] = []
    for segment in segments:
        if not length(segment):
            pending.append(segment)
            continue
        last = out[-1] if out else None
        smooth = last is not None and length(last) and last.direction == segment.direction
        if (
            last is not None
            and smooth
            and abs(turn_between(last.yaw, segment.yaw)) < MAX_CURVE_RAD
            and len(pending) < 2
        ):
            out[-1] = PathSegment(
                np.concatenate([last.points, segment.points[1:]]),
                segment.direction,
                segment.yaw,
            )
        else:
            out += [*pending, segment]
        pending = []
    return out + pending


def _pulled(plan: Floorplan, segments: Sequence[PathSegment]) -> list[PathSegment]:
    """Segments without the points that a straight line with as much or ample clearance can skip."""
    out = []
    for segment in segments:
        kept = [0]
        back = 0.0 if segment.direction > 0 else np.pi
        while kept[-1] < len(segment.points) - 1:
            kept.append(_farthest(plan, segment.points, kept[-1], back))
        out.append(PathSegment(segment.points[kept], segment.direction, segment.yaw))
    return out


def _farthest(plan: Floorplan, points: np.ndarray, i: int, back: float) -> int:
    """Index of the last of ``points`` (P, 2) that a straight line from point ``i`` may lead to.

    ``back``: 0 forwards, pi backwards.
    """
    for j in range(len(points) - 1, i + 1, -1):
        if _line_clearance(plan, points[[i, j]], back) >= min(
            AMPLE_CLEARANCE_M, _line_clearance(plan, points[i : j + 1], back)
        ):
            return j
    return i + 1


def _line_clearance(plan: Floorplan, points: np.ndarray, back: float) -> float:
    """Least clearance on straight lines between ``points`` (P, 2), facing along them (``back`` pi: against them)."""
    poses = []
    for a, b in pairwise(points):
        offset = b - a
        share = np.linspace(0.0, 1.0, 2 + int(np.linalg.norm(offset) / 0.05))[:, None]
        yaw = np.arctan2(offset[1], offset[0]) + back
        poses.append(np.column_stack([a + share * offset, np.full(len(share), yaw)]))
    return float(plan.clearance(np.concatenate(poses)).min())


def simulate(
    pose: np.ndarray, segments: Sequence[PathSegment], lookahead: float, pace: Pace
) -> np.ndarray:
    """Simulate the base poses (T, 3) of a drive from ``pose`` (3,) along segments, one per control step."""
    pose = pose.copy()
    speed = 0.0
    rate = 0.0
    share = 1.0 - np.exp(-STEP_SECONDS / SPEED_LAG_S)
    poses = []
    driver = Driver(segments, lookahead, pace)
    while driver.segment is not None:
        forward, turn = driver.step(pose)
        speed += share * (forward - speed)
        rate += share * (turn - rate)
        pose = pose + STEP_SECONDS * np.array(
            [speed * np.cos(pose[2]), speed * np.sin(pose[2]), rate]
        )
        poses.append(pose)
    return np.array(poses).reshape(-1, 3)
