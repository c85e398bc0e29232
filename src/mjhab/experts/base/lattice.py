"""Lattice search over position and heading: straight pieces, forwards or backwards, and turns on the spot.

The lattice has sixteen headings, along which a straight step leads exactly from grid point to grid point. Clearance
includes the arm, so that the robot turns where the arm has room and backs out of where it has not. Lengths [m],
angles [rad], world frame, costs [s].

A search takes a third of a second: it is for Navigate. With the grid of `navigation`, which does not know the arm, 5 of
48 drives touch something instead of 1 (docs/results/experts.md).

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from mjhab.experts.arm import motion
from mjhab.experts.base.floorplan import Floorplan, turn_between
from mjhab.experts.base.follower import PathSegment, turns

MOVES = np.array(
    [(1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1),
     (-1, 0), (-2, -1), (-1, -1), (-1, -2), (0, -1), (1, -2), (1, -1), (2, -1)]
)  # fmt: skip
"""One step along every heading, in grid points."""
YAWS = np.arctan2(MOVES[:, 1], MOVES[:, 0])
CELLS_PER_STEP = 2
"""Cells of the map between two neighbours of the grid."""
SPEED_M_S = 0.8
"""Speed on straight pieces, from which their cost in seconds follows."""
BACKWARDS_FACTOR = 2.0
"""Factor on the cost of driving backwards."""
TURN_RATE_RAD_S = 1.8
"""Yaw rate of turns on the spot, from which their cost follows."""
TURN_COST_S = 0.15
"""Cost of every turn to the next heading in addition to its duration."""
COMFORT_CLEARANCE_M = 0.15
"""Clearance below which costs increase."""
CAUTION_FACTOR = 3.0
"""Without spare clearance, a metre costs 1 + CAUTION_FACTOR times as much as with `COMFORT_CLEARANCE_M`."""
START_DISTANCES_M = np.array(
    [0.0, -0.1, -0.2, -0.3, -0.4, -0.5, -0.6, -0.7, -0.8, 0.1, 0.2, 0.3, 0.4]
)
"""Candidates for the length of the straight piece before the first turn, negative backwards."""
LACKING_PRICE_S_M = 40.0
"""Cost of missing clearance during the first turn [s/m]."""
MAX_ENTRY_M = 0.12
"""Greatest distance between the robot and the first node of the path. With grid points 0.1 m apart the nearest one is
at most 0.07 m away, but it may lack clearance."""


class Lattice:
    """Lattice of one floor plan: H headings, X times Y grid points; the number of a node is (h * X + x) * Y + y.

    Attributes:
        points: (X, Y, 2) positions of the grid points.
        clearance: (H, X, Y) clearance of base and arm at the nodes beyond what they need.
        shape: (H, X, Y).
    """

    def __init__(self, plan: Floorplan) -> None:
        self.plan = plan
        # Turns to the next heading are checked half way as well: the arm reaches far.
        between = YAWS + 0.5 * (np.roll(YAWS, -1) - YAWS) % np.pi
        fine = plan.clearances(np.concatenate([YAWS, between]))
        self._fine = fine[:16]
        self._between = fine[16:, ::CELLS_PER_STEP, ::CELLS_PER_STEP]
        self.clearance = self._fine[:, ::CELLS_PER_STEP, ::CELLS_PER_STEP]
        self.shape = self.clearance.shape
        index = np.moveaxis(np.indices(self.shape[1:]), 0, -1)
        self.points = plan.origin + (CELLS_PER_STEP * index + 0.5) * plan.cell
        self._edges = self._make_edges()

    def search(
        self, pose: np.ndarray, price: np.ndarray
    ) -> tuple[float, list[PathSegment]] | None:
        """Search the path with the least cost from a base pose to any node, including the node's end cost.

        Args:
            pose: (3,) base pose x, y, yaw.
            price: (H, X, Y) cost of each node as the end of the path [s], infinite where it must not end.

        Returns:
            Cost [s] and segments, or None when no node with a finite end cost can be reached.
        """
        entries = self._entries(pose)
        if not entries:
            return None
        size = int(np.prod(self.shape))
        starts, ends, costs = self._edges
        nodes = np.array(list(entries))
        first = np.array([entry[0] for entry in entries.values()])
        graph = csr_matrix(
            (
                np.concatenate([costs, first]),
                (
                    # One more node for the start, from which all entries lead at their own cost.
                    np.concatenate([starts, np.full(len(nodes), size)]),
                    np.concatenate([ends, nodes]),
                ),
            ),
            shape=(size + 1, size + 1),
        )
        cost, before = dijkstra(graph, indices=size, return_predecessors=True)
        # The end costs, too: one search compares all places at which the drive may end.
        total = np.asarray(cost)[:size] + price.ravel()
        best = int(np.argmin(total))
        if not np.isfinite(total[best]):
            return None
        path = [best]
        while before[path[-1]] != size:
            path.append(int(before[path[-1]]))
        path.reverse()
        return float(total[best]), self._segments(pose, entries[path[0]][1:], path)

    def _make_edges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Start nodes, end nodes and costs [s] of all moves between nodes with enough clearance."""
        number = np.arange(int(np.prod(self.shape))).reshape(self.shape)
        fits = self.clearance >= 0.0
        lack = np.clip(
            (COMFORT_CLEARANCE_M - self.clearance) / COMFORT_CLEARANCE_M, 0.0, 1.0
        )
        dear = 1.0 + CAUTION_FACTOR * lack**2
        parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for h, (dx, dy) in enumerate(MOVES.tolist()):
            a, b = _windows(self.shape[1:], dx, dy)
            # A diagonal step can pass a corner between its ends.
            good = fits[h][a] & fits[h][b] & self._midway(h, a, dx, dy)
            pay = (
                0.5
                * (dear[h][a] + dear[h][b])[good]
                * np.hypot(dx, dy)
                * CELLS_PER_STEP
                * self.plan.cell
                / SPEED_M_S
            )
            start = number[h][a][good]
            end = number[h][b][good]
            parts += [(start, end, pay), (end, start, BACKWARDS_FACTOR * pay)]
            k = (h + 1) % 16
            good = fits[h] & fits[k] & (self._between[h] >= 0.0)
            angle = abs(turn_between(YAWS[h], YAWS[k]))
            pay = (
                (angle / TURN_RATE_RAD_S + TURN_COST_S) * 0.5 * (dear[h] + dear[k])[good]
            )
            parts += [
                (number[h][good], number[k][good], pay),
                (number[k][good], number[h][good], pay),
            ]
        joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return joined[0], joined[1], joined[2]

    def _midway(self, h: int, a: tuple[slice, slice], dx: int, dy: int) -> np.ndarray:
        """Whether the midpoint has enough clearance, for moves with heading ``h`` that start in the window ``a``."""
        rows = np.arange(self.shape[1])[a[0]] * CELLS_PER_STEP + dx * CELLS_PER_STEP // 2
        columns = (
            np.arange(self.shape[2])[a[1]] * CELLS_PER_STEP + dy * CELLS_PER_STEP // 2
        )
        return self._fine[h][np.ix_(rows, columns)] >= 0.0

    def _entries(self, pose: np.ndarray) -> dict[int, tuple[float, float, float]]:
        """Nodes at which a path may begin: cost [s], length of the straight piece to the node, turn there (signed).

        A robot that is too close to an obstacle may move wherever it does not get closer.
        """
        asked = min(0.0, float(self.plan.clearance(pose[None])[0]) - 0.015)
        ahead = motion.ahead(pose[2])
        found: dict[int, tuple[float, float, float]] = {}
        for far in START_DISTANCES_M.tolist():
            share = np.linspace(0.0, 1.0, 2 + int(abs(far) / 0.05))[:, None]
            line = np.column_stack(
                [pose[:2] + share * far * ahead, np.full(len(share), pose[2])]
            )
            if self.plan.clearance(line).min() < asked:
                continue
            pay = abs(far) / SPEED_M_S * (BACKWARDS_FACTOR if far < 0 else 1.0) + (
                0.5 if far else 0.0
            )
            for h in range(16):
                node = self._near(line[-1, :2], h)
                if node < 0:
                    continue
                short = turn_between(pose[2], YAWS[h])
                # The long way round may be free where the short one sweeps the arm through an obstacle.
                for turn in (short, short - np.copysign(2 * np.pi, short)):
                    cost = pay + abs(turn) / TURN_RATE_RAD_S
                    # Before the turn is checked, which is the dear part.
                    if node in found and found[node][0] <= cost:
                        continue
                    min_clearance = self.plan.turning(line[-1, :2], float(pose[2]), turn)
                    cost += LACKING_PRICE_S_M * max(0.03 - min_clearance, 0.0)
                    if min_clearance >= asked and (
                        node not in found or cost < found[node][0]
                    ):
                        found[node] = (cost, far, turn)
        return found

    def _near(self, xy: np.ndarray, h: int) -> int:
        """Node with heading ``h`` and enough clearance nearest to ``xy`` (2,); -1 if none is within `MAX_ENTRY_M`."""
        at = (xy - self.plan.origin) / self.plan.cell - 0.5
        low = np.floor(at / CELLS_PER_STEP).astype(int)
        x, y = np.meshgrid([low[0], low[0] + 1], [low[1], low[1] + 1], indexing="ij")
        x = np.clip(x.ravel(), 0, self.shape[1] - 1)
        y = np.clip(y.ravel(), 0, self.shape[2] - 1)
        gap = np.linalg.norm(self.points[x, y] - xy, axis=1)
        gap = np.where(self.clearance[h, x, y] >= 0.0, gap, np.inf)
        best = int(np.argmin(gap))
        return (
            int((h * self.shape[1] + x[best]) * self.shape[2] + y[best])
            if gap[best] <= MAX_ENTRY_M
            else -1
        )

    def _segments(
        self, pose: np.ndarray, entry: tuple[float, float], path: Sequence[int]
    ) -> list[PathSegment]:
        """Segments along the nodes ``path``, with a turn on the spot wherever the heading changes."""
        h, x, y = np.unravel_index(np.asarray(path), self.shape)
        far, turn = entry
        here = pose[:2] + far * motion.ahead(pose[2])
        yaw = float(pose[2])
        segments = (
            [PathSegment(np.stack([pose[:2], here]), -1 if far < 0 else 1, yaw)]
            if far
            else []
        )
        for k in range(1, len(path)):
            if h[k] != h[k - 1]:
                turn += turn_between(float(YAWS[h[k - 1]]), float(YAWS[h[k]]))
                continue
            segments += turns(here, yaw, turn)
            there = self.points[x[k], y[k]]
            yaw = float(YAWS[h[k]])
            turn = 0.0
            direction = (
                1 if (x[k] - x[k - 1], y[k] - y[k - 1]) == tuple(MOVES[h[k]]) else -1
            )
            last = segments[-1] if segments else None
            if (
                last is not None
                and last.length
                and last.direction == direction
                and last.yaw == yaw
            ):
                segments[-1] = PathSegment(
                    np.stack([last.points[0], there]), direction, yaw
                )
            else:
                segments.append(PathSegment(np.stack([here, there]), direction, yaw))
            here = there
        return segments + turns(here, yaw, turn)


def _windows(
    shape: Sequence[int], dx: int, dy: int
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Windows of the grid points from which a step (dx, dy) stays on the grid, and of those that it leads to."""
    starts = []
    ends = []
    for size, d in zip(shape, (dx, dy), strict=True):
        starts.append(slice(max(0, -d), size - max(0, d)))
        ends.append(slice(max(0, d), size - max(0, -d)))
    return (starts[0], starts[1]), (ends[0], ends[1])
