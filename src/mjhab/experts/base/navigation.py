"""Shortest paths on a map of free floor, and a path follower for a base with differential drive.

The map is a grid of clearances: the distance [m] from each cell's centre to the nearest obstacle. Frames: world xy
[m], yaw [rad]. Speeds [m/s], [rad/s].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import dijkstra

from mjhab.core.errors import UsageError
from mjhab.core.grids import grid_graph
from mjhab.core.memory_cache import MemoryCache
from mjhab.core.timing import STEP_SECONDS
from mjhab.robots.kinematics import wrap

Array = np.ndarray
KEPT_SOURCES = 4
"""Number of starts whose ways to everywhere a `Planner` keeps."""
NARROW_FACTOR = 20.0
"""Factor on the cost of a metre where the clearance is less than ``radius``: larger than any detour through a home."""


@dataclass(frozen=True, eq=False)
class FloorClearance:
    """A map of a floor: ``origin`` (2,): world xy [m] of the corner of cell (0, 0); ``cell``: edge length [m];
    ``clearance`` (nx, ny): distance of each cell's centre to the nearest obstacle [m]."""

    origin: Sequence[float] | Array
    cell: float
    clearance: Array


class Planner:
    """Shortest ways over one map; build it once per home, it holds the graph of the free cells.

    Args:
        floor: the map.
        radius: clearance the base should have.
        narrow: clearance it can do with where there is no other way; as ``radius`` if not given.
        comfort: clearance beyond ``radius`` that is worth a detour; a cell at ``radius`` costs ``1 + caution`` times
            its length.
        caution: see ``comfort``.
    """

    def __init__(
        self,
        floor: FloorClearance,
        radius: float = 0.3,
        comfort: float = 0.25,
        caution: float = 4.0,
        narrow: float | None = None,
    ) -> None:
        self.origin = np.asarray(floor.origin, dtype=np.float64)
        self.cell = float(floor.cell)
        self.radius = float(radius)
        self.comfort = float(comfort)
        self.caution = caution
        self.clearance = np.asarray(floor.clearance, dtype=np.float64)
        self.free = self.clearance >= radius
        if not self.free.any():
            raise UsageError(
                f"no cell of the map has a clearance of {radius} m; give a smaller radius or another home"
            )
        self.narrow = radius if narrow is None else narrow
        passable = self.clearance >= self.narrow
        lack = np.clip((radius + comfort - self.clearance) / comfort, 0.0, 1.0)
        price = np.where(self.free, 1.0 + caution * lack**2, NARROW_FACTOR)
        self._graph = grid_graph(passable, self.cell, price=price)
        self._ways = MemoryCache("distance fields", KEPT_SOURCES)

    def clearance_at(self, points: Array) -> Array:
        """Clearance (...,) of the cells that hold world points (..., 2); 0 outside the map."""
        index = np.floor((np.asarray(points) - self.origin) / self.cell).astype(np.int64)
        inside = ((index >= 0) & (index < self.clearance.shape)).all(axis=-1)
        index = np.clip(index, 0, np.array(self.clearance.shape) - 1)
        return np.where(inside, self.clearance[index[..., 0], index[..., 1]], 0.0)

    def nearest_free(self, point: Array) -> Array:
        """``point`` (2,) itself when the base fits there, else the centre (2,) of the nearest cell where it does."""
        point = np.asarray(point, dtype=np.float64)[:2]
        if self.clearance_at(point) >= self.radius:
            return point
        cells = np.argwhere(self.free)
        centres = self.origin + (cells + 0.5) * self.cell
        return centres[np.argmin(np.sum((centres - point) ** 2, axis=1))]

    def plan(self, start: Array, goal: Array) -> Array | None:
        """Way points (P, 2) from ``start`` (2,) to ``goal`` (2,), or None when they are not connected.

        A start too near to an obstacle first leads to the nearest free cell. A goal where the base does not fit is
        replaced by the nearest free cell: the last way point says where the way really ends.
        """
        start = np.asarray(start, dtype=np.float64)[:2]
        goal = self.nearest_free(goal)
        entry = self.nearest_free(start)
        source = self._node(entry)
        target = self._node(goal)
        cost, before = self._ways_from(source)
        if not np.isfinite(cost[target]):
            return None
        nodes = [target]
        while nodes[-1] != source:
            nodes.append(int(before[nodes[-1]]))
        cells = np.stack(np.unravel_index(nodes[::-1], self.clearance.shape), axis=1)
        points = self.origin + (cells + 0.5) * self.cell
        points = np.concatenate([entry[None], points[1:-1], goal[None]])
        path = self._pull(points)
        return path if np.allclose(entry, start) else np.concatenate([start[None], path])

    def distance(self, start: Array, goal: Array) -> float:
        """Length [m] of the planned way, infinite when there is none."""
        path = self.plan(start, goal)
        return (
            np.inf if path is None else float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        )

    def costs(self, start: Array) -> Array:
        """Cost (nx, ny) of the ways from ``start`` (2,) to all cells [m, more where it is narrow], inf if no way."""
        cost, _ = self._ways_from(self._node(self.nearest_free(start)))
        return cost.reshape(self.clearance.shape)

    def costs_to(self, cells: Array) -> Array:
        """Cost (nx, ny) of the ways from all cells to the nearest of ``cells`` (nx, ny) bool, inf if no way."""
        found = dijkstra(self._graph, directed=False, indices=np.flatnonzero(cells), min_only=True)
        return np.asarray(found).reshape(self.clearance.shape)

    def cells(self, points: Array) -> tuple[Array, Array]:
        """Indices (...,), (...,) of the cells that hold world points (..., 2), moved into the map."""
        index = np.floor((np.asarray(points) - self.origin) / self.cell).astype(np.int64)
        index = np.clip(index, 0, np.array(self.clearance.shape) - 1)
        return index[..., 0], index[..., 1]

    def line_clearance(self, start: Array, ends: Array) -> Array:
        """Least clearance (E,) on the straight lines from ``start`` (2,) to ``ends`` (E, 2)."""
        ends = np.atleast_2d(ends)
        longest = np.max(np.linalg.norm(ends - start, axis=1), initial=0.0)
        share = np.linspace(0.0, 1.0, 2 + int(longest / (0.5 * self.cell)))[:, None, None]
        return self.clearance_at(start + share * (ends - start)).min(axis=0)

    def _pull(self, points: Array) -> Array:
        """Drop way points where a straight line keeps the clearance of what it replaces (up to the comfortable one)."""
        own = self.clearance_at(points)
        kept = [0]
        i = 0
        last = len(points) - 1
        while i < last:
            asked = np.minimum(np.minimum.accumulate(own[i:])[1:], self.radius + self.comfort)
            good = np.flatnonzero(self.line_clearance(points[i], points[i + 1 :]) >= asked - 1e-9)
            i += 1 + (int(good[-1]) if len(good) else 0)
            kept.append(i)
        return points[kept]

    def _ways_from(self, source: int) -> tuple[Array, Array]:
        """Cost of the ways from a node to all nodes, and the node before each of them.

        The last ones are kept: many goals are compared from where the robot stands.
        """
        return self._ways.get(source, lambda: self._find_ways(source))

    def _find_ways(self, source: int) -> tuple[Array, Array]:
        found = dijkstra(self._graph, directed=False, indices=source, return_predecessors=True)
        return np.asarray(found[0]), np.asarray(found[1])

    def _node(self, point: Array) -> int:
        x, y = np.floor((point - self.origin) / self.cell).astype(np.int64)
        return int(x * self.clearance.shape[1] + y)


@dataclass(frozen=True)
class DriveLimits:
    """Bounds and gains of `Follower`. The gains act on the pose expected ``preview`` seconds ahead, which makes up for
    the base's time constant of about 0.15 s. ``reverse_below``: ways shorter than this may be driven backwards."""

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
    """Commands of one control step: forward speed [m/s], yaw rate [rad/s], and whether the base stands at its goal."""

    v: float
    w: float
    done: bool


class Follower:
    """Drives a base that cannot move sideways along way points, then turns it to a final heading.

    Args:
        path: (P, 2) way points; the first is where the base is.
        final_yaw: heading at the end; None: whatever it is on arrival.
        limits: speeds, gains, tolerances.
        direction: 1 forwards, -1 backwards, 0 chosen from the first pose: backwards only on ways shorter than
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
        """Length of the way [m]."""
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
        """Speed that takes out what is left along the heading, while the base turns on the spot."""
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
        """Move the projection onto the way forward (never back) and return its arc length."""
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
        """Arc length to the next inner way point, for slowing down before it turns."""
        ahead = self._along[1:-1] - (self.length - left)
        ahead = ahead[ahead > -0.05]
        return float(max(ahead[0], 0.0)) if len(ahead) else np.inf

    def _ahead(self, pose: Array) -> float:
        to_goal = self.path[-1] - pose[:2]
        return float(np.cos(pose[2]) * to_goal[0] + np.sin(pose[2]) * to_goal[1])

    def _beside(self, pose: Array, gap: float) -> bool:
        """The goal lies sideways within tolerance: driving on would not come nearer."""
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
