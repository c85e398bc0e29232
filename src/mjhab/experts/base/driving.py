"""Driving along a path of segments: base commands, the choice of curves or turns on the spot, simulated base poses.

Lengths [m], angles [rad], world frame. Letters: T control steps, P points.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from mjhab.core.rotations import wrap
from mjhab.core.timing import STEP_SECONDS
from mjhab.experts.base.floorplan import Floorplan, turn_between
from mjhab.experts.base.follower import BaseTrajectory, PathSegment
from mjhab.experts.base.limits import CommandLimits

WANTED_CLEARANCE_M = 0.02
"""Clearance that a drive should keep beyond the least one."""
CLOSENESS_PRICE_S_M2 = 5000.0
"""Cost of a drive with less clearance, per square of the missing clearance [s/m2]."""
AMPLE_CLEARANCE_M = 0.08
"""Clearance of a straight line with which it may replace way points that have more."""
MAX_SPLITS = 8
"""Greatest number of curves that are replaced by turns on the spot for lack of clearance."""
MAX_CURVE_RAD = 2.0
"""Turns up to this are driven as curves, not on the spot."""


def plan_drive(
    plan: Floorplan,
    pose: np.ndarray,
    segments: Sequence[PathSegment],
    limits: CommandLimits,
) -> BaseTrajectory:
    """Plan the quickest drive along segments that keeps about the clearance that the segments have.

    The drive uses curves, and turns on the spot where a curve comes too close to an obstacle.

    Args:
        plan: free space.
        pose: (3,) present base pose x, y, yaw.
        segments: the path, with turns on the spot.
        limits: limits on the commands.
    """
    curves = _joined(segments)
    pulled = _pulled(plan, curves)
    # A robot that stands close to an obstacle cannot ask for more than it has.
    asked = min(WANTED_CLEARANCE_M, float(plan.clearance(pose[None])[0]) - 0.03)
    best: tuple[float, BaseTrajectory] | None = None
    # From the quickest drive to the one that keeps to the path best.
    for choice, lookahead in (
        (pulled, 0.3),
        (pulled, 0.2),
        (curves, 0.2),
        (segments, 0.1),
    ):
        tried: Sequence[PathSegment] | None = choice
        for _ in range(MAX_SPLITS):
            trajectory = BaseTrajectory.of(pose, tried, lookahead, limits)
            clearance = plan.clearance(trajectory.poses)
            lack = max(asked - float(clearance.min(initial=np.inf)), 0.0)
            # By the square, so that a millimetre costs next to nothing and a touch more than any detour.
            cost = STEP_SECONDS * len(trajectory.poses) + CLOSENESS_PRICE_S_M2 * lack**2
            if best is None or cost < best[0]:
                best = (cost, trajectory)
            # The first that keeps the clearance is the quickest, by the order of the choices.
            if lack == 0.0:
                return best[1]
            # There where it is tightest: one turn on the spot is often enough.
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
        # Turns on the spot wait until it is known whether the next piece takes them up.
        if not segment.length:
            pending.append(segment)
            continue
        last = out[-1] if out else None
        smooth = last is not None and last.length and last.direction == segment.direction
        if (
            last is not None
            and smooth
            and abs(turn_between(last.yaw, segment.yaw)) < MAX_CURVE_RAD
            # Two turns on the spot in a row are more than `MAX_CURVE_RAD`.
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
    # From the far end: the first that works skips most.
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
