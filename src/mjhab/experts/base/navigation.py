"""Shortest paths on a map of free floor.

The map is a grid of clearances: the distance [m] from each cell's centre to the nearest obstacle. Frames: world xy
[m].

A path takes milliseconds: it is for the tens of routes that a search of Pick or Place compares. The `lattice` takes
hundreds of times as long.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import dijkstra

from mjhab.core.errors import UsageError
from mjhab.core.grids import grid_graph
from mjhab.core.memory_cache import MemoryCache

KEPT_SOURCES = 4
"""Number of starts whose shortest-path trees a `Planner` keeps."""
NARROW_FACTOR = 20.0
"""Factor on the cost of a metre where the clearance is less than ``radius``: larger than any detour through a home."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Square cells of the floor.

    Attributes:
        origin: (2,) world xy of the corner of cell (0, 0) [m].
        cell: edge length of a cell [m].
        shape: number of cells in x and y.
    """

    origin: np.ndarray
    cell: float
    shape: tuple[int, ...]

    @property
    def centres(self) -> np.ndarray:
        """World xy (nx, ny, 2) [m] of the cells' centres."""
        return (
            self.origin + (np.moveaxis(np.indices(self.shape), 0, -1) + 0.5) * self.cell
        )

    def cells(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Indices (...,), (...,) of the cells that contain world points (..., 2), clipped to the grid."""
        index = np.floor((np.asarray(points) - self.origin) / self.cell).astype(np.int64)
        index = np.clip(index, 0, np.array(self.shape) - 1)
        return index[..., 0], index[..., 1]


@dataclass(frozen=True, eq=False)
class FloorClearance:
    """Map of free floor.

    Attributes:
        origin: (2,) world xy of the corner of cell (0, 0) [m].
        cell: edge length of a cell [m].
        clearance: (nx, ny) distance of each cell's centre to the nearest obstacle [m].
    """

    origin: Sequence[float] | np.ndarray
    cell: float
    clearance: np.ndarray


class Planner:
    """Shortest-path planner on one map; it builds the graph of the free cells once.

    Args:
        floor: the map.
        radius: clearance that the base should have [m].
        comfort: clearance beyond ``radius`` below which costs increase [m].
        caution: a path of some length at clearance ``radius`` costs ``1 + caution`` times its length.
        narrow: clearance with which the base can still pass, at `NARROW_FACTOR` times the cost [m]; ``radius`` if not
            given.

    Raises:
        UsageError: no cell has a clearance of ``radius``.
    """

    def __init__(
        self,
        floor: FloorClearance,
        radius: float = 0.3,
        comfort: float = 0.25,
        caution: float = 4.0,
        narrow: float | None = None,
    ) -> None:
        clearance = np.asarray(floor.clearance, dtype=np.float64)
        self.origin = np.asarray(floor.origin, dtype=np.float64)
        self.cell = float(floor.cell)
        self.grid = Grid(self.origin, self.cell, clearance.shape)
        self.radius = float(radius)
        self.comfort = float(comfort)
        self.caution = caution
        self.clearance = clearance
        self.free = self.clearance >= radius
        if not self.free.any():
            raise UsageError(
                f"no cell of the map has a clearance of {radius} m; give a smaller radius or another home"
            )
        # Narrow cells cost more than any detour, so that they are used only where there is none.
        self.narrow = radius if narrow is None else narrow
        passable = self.clearance >= self.narrow
        lack = np.clip((radius + comfort - self.clearance) / comfort, 0.0, 1.0)
        # By the square, so that a path keeps its distance only where that costs little.
        price = np.where(self.free, 1.0 + caution * lack**2, NARROW_FACTOR)
        self._graph = grid_graph(passable, self.cell, price=price)
        self._fields = MemoryCache("distance fields", KEPT_SOURCES)

    def clearance_at(self, points: np.ndarray) -> np.ndarray:
        """Clearance (...,) [m] of the cells that contain world points (..., 2); 0 outside the map."""
        share = (np.asarray(points) - self.origin) / self.cell
        inside = ((share >= 0) & (share < self.clearance.shape)).all(axis=-1)
        return np.where(inside, self.clearance[self.grid.cells(points)], 0.0)

    def nearest_free(self, point: np.ndarray) -> np.ndarray:
        """``point`` (2,) itself when the base fits there, else the centre (2,) of the nearest cell where it does."""
        point = np.asarray(point, dtype=np.float64)[:2]
        if self.clearance_at(point) >= self.radius:
            return point
        centres = self.grid.centres[self.free]
        return centres[np.argmin(np.sum((centres - point) ** 2, axis=1))]

    def plan(self, start: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
        """Plan way points (P, 2) from ``start`` (2,) to ``goal`` (2,); None when they are not connected.

        From a start without enough clearance the path first leads to the nearest free cell. A goal without enough
        clearance is replaced by the nearest free cell, which is then the last way point.
        """
        start = np.asarray(start, dtype=np.float64)[:2]
        goal = self.nearest_free(goal)
        entry = self.nearest_free(start)
        source = self._node(entry)
        target = self._node(goal)
        cost, before = self._fields_from(source)
        if not np.isfinite(cost[target]):
            return None
        nodes = [target]
        while nodes[-1] != source:
            nodes.append(int(before[nodes[-1]]))
        cells = np.stack(np.unravel_index(nodes[::-1], self.clearance.shape), axis=1)
        points = self.origin + (cells + 0.5) * self.cell
        # The ends themselves in place of the middles of their cells.
        points = np.concatenate([entry[None], points[1:-1], goal[None]])
        path = self._pull(points)
        return path if np.allclose(entry, start) else np.concatenate([start[None], path])

    def costs(self, start: np.ndarray) -> np.ndarray:
        """Cost (nx, ny) of the paths from ``start`` (2,) to all cells: metres, weighted by clearance; inf if none."""
        cost, _ = self._fields_from(self._node(self.nearest_free(start)))
        return cost.reshape(self.clearance.shape)

    def costs_to(self, cells: np.ndarray) -> np.ndarray:
        """Cost (nx, ny) of the paths from all cells to the nearest of ``cells`` (nx, ny) bool; inf if none."""
        found = dijkstra(
            # One search from all of them together.
            self._graph,
            directed=False,
            indices=np.flatnonzero(cells),
            min_only=True,
        )
        return np.asarray(found).reshape(self.clearance.shape)

    def line_clearance(self, start: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Least clearance (E,) [m] on the straight lines from ``start`` (2,) to ``ends`` (E, 2)."""
        ends = np.atleast_2d(ends)
        longest = np.max(np.linalg.norm(ends - start, axis=1), initial=0.0)
        share = np.linspace(0.0, 1.0, 2 + int(longest / (0.5 * self.cell)))[:, None, None]
        return self.clearance_at(start + share * (ends - start)).min(axis=0)

    def _pull(self, points: np.ndarray) -> np.ndarray:
        """Drop way points that a straight line can skip with the same clearance, or with the comfortable one."""
        own = self.clearance_at(points)
        kept = [0]
        i = 0
        last = len(points) - 1
        while i < last:
            asked = np.minimum(
                # A short cut may be as tight as the path that it replaces.
                np.minimum.accumulate(own[i:])[1:],
                self.radius + self.comfort,
            )
            good = np.flatnonzero(
                self.line_clearance(points[i], points[i + 1 :]) >= asked - 1e-9
            )
            # The farthest point in sight; at least the next one, which is a neighbour.
            i += 1 + (int(good[-1]) if len(good) else 0)
            kept.append(i)
        return points[kept]

    def _fields_from(self, source: int) -> tuple[np.ndarray, np.ndarray]:
        """Costs of the paths from a node to all nodes, and the predecessor of each node.

        The latest results are kept, because many goals are compared from the same start.
        """
        return self._fields.get(source, lambda: self._find_fields(source))

    def _find_fields(self, source: int) -> tuple[np.ndarray, np.ndarray]:
        found = dijkstra(
            self._graph, directed=False, indices=source, return_predecessors=True
        )
        return np.asarray(found[0]), np.asarray(found[1])

    def _node(self, point: np.ndarray) -> int:
        x, y = np.floor((point - self.origin) / self.cell).astype(np.int64)
        return int(x * self.clearance.shape[1] + y)
