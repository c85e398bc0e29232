"""Free space of a mobile base: an occupancy grid of a home, its clearance, and shortest paths.

It is computed from the scene description, without a simulator: every colliding geom between the floor and the height of
the robot is rasterised as the convex hull of its horizontal projection, doors and drawers closed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import distance_transform_edt, label
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from mjhab.core.errors import UsageError
from mjhab.core.grids import SIXTEEN, grid_graph
from mjhab.core.memory_cache import MemoryCache
from mjhab.scenes.shapes.blocking import blocking_polygons
from mjhab.scenes.shapes.footprints import rectangle
from mjhab.scenes.spec import Home, Pack, Prop

NAVMESH_BASE_RADIUS_M = 0.3
"""Radius [m] of the robot that HAB computes its navigation meshes for."""
MAX_KEPT_FIELDS = 4
"""Number of distance fields that a map caches; one of an apartment takes about 0.2 MB."""
_ROWS = 64
"""Sources whose paths are computed together; a row of a large home has 60,000 numbers."""
_BORDER_M = 0.3
"""Margin of the raster around the floor [m], so that it includes the outer walls."""


@dataclass(frozen=True, eq=False)
class FreeMap:
    """Free floor of one home. Cell (i, j) covers x from ``origin[0] + i * cell``, y from ``origin[1] + j * cell``.

    ``blocked`` (X, Y) bool; ``clearance`` (X, Y) [m]: Euclidean distance from the cell's centre to the nearest
    blocked cell's centre less half a cell, 0 in blocked cells and outside the floor.
    """

    origin: tuple[float, float]
    cell: float
    blocked: np.ndarray
    clearance: np.ndarray

    def navigable(self, radius: float = NAVMESH_BASE_RADIUS_M) -> np.ndarray:
        """Compute the cells (X, Y) bool where a disc of ``radius`` [m] fits, restricted to the largest component."""
        fits = self.clearance >= radius
        pieces = np.empty(fits.shape, np.int32)
        # With diagonal neighbours, along which paths lead as well.
        label(fits, structure=np.ones((3, 3)), output=pieces)
        if not fits.any():
            return fits
        sizes = np.bincount(pieces.ravel())
        # Label 0 is everything that is not free, mostly the largest.
        sizes[0] = 0
        return pieces == sizes.argmax()

    def to_cell(self, xy: np.ndarray) -> np.ndarray:
        """Convert world positions (..., 2) [m] to cell indices (..., 2) int, clipped to the raster."""
        # Floor instead of a cast, which would round negative positions towards the raster.
        index = np.floor(
            (np.asarray(xy, float) - np.array(self.origin)) / self.cell
        ).astype(int)
        return np.clip(index, 0, np.array(self.blocked.shape) - 1)

    def to_xy(self, cells: np.ndarray) -> np.ndarray:
        """Convert cell indices (..., 2) to the world positions (..., 2) [m] of the cells' centres."""
        return (np.asarray(cells) + 0.5) * self.cell + np.array(self.origin)

    def clearance_at(self, xy: np.ndarray) -> np.ndarray:
        """Look up the clearance (...,) [m] at world positions (..., 2) [m]; 0 outside the raster."""
        index = np.floor(
            (np.asarray(xy, float) - np.array(self.origin)) / self.cell
        ).astype(int)
        inside = np.all((index >= 0) & (index < np.array(self.blocked.shape)), axis=-1)
        index = np.clip(index, 0, np.array(self.blocked.shape) - 1)
        return np.where(inside, self.clearance[index[..., 0], index[..., 1]], 0.0)

    def distances_to(self, xy: np.ndarray) -> np.ndarray:
        """Compute the length (X, Y) float32 [m] of the shortest path of the base from every cell to a goal.

        Paths lead through the cells of `navigable`, from centre to centre on a 16-connected grid, and are up to 3 %
        longer than the shortest ones. A start or goal outside of them is replaced by the nearest cell of them, and the
        straight distance to it is added, so that every cell has a finite distance.

        Args:
            xy: (2,) goal in the world [m].

        Returns:
            Read-only array; those of the last `MAX_KEPT_FIELDS` goals are cached.

        Raises:
            UsageError: the base fits nowhere.
        """
        goal = np.asarray(xy, float)[:2]
        return self._fields.get(tuple(goal.tolist()), lambda: self._field(goal))

    def distance(self, a: np.ndarray, b: np.ndarray) -> float:
        """Compute the length [m] of the shortest path of the base between ``a`` and ``b`` (2,), see `distances_to`."""
        field = self.distances_to(b)[None]
        origin = np.array([self.origin])
        cell = np.array([self.cell])
        return float(
            look_up(
                field,
                origin,
                cell,
                np.array([field.shape[1:]]),
                np.asarray(a, float)[None, :2],
            )[0]
        )

    def ways_between(self, cells: np.ndarray) -> np.ndarray:
        """Compute the lengths (V, V) float32 [m] of the shortest paths between cells (V, 2) of `navigable`."""
        graph = self._ways[0]
        nodes = cells[:, 0] * self.blocked.shape[1] + cells[:, 1]
        # In parts, since a row holds the distances to all cells of the home.
        found = [
            np.asarray(dijkstra(graph, directed=False, indices=part))[:, nodes]
            for part in np.array_split(nodes, max(1, len(nodes) // _ROWS))
        ]
        return np.concatenate(found).astype(np.float32)

    def _field(self, goal: np.ndarray) -> np.ndarray:
        graph, nearest, off = self._ways
        x, y = self.to_cell(goal)
        node = int(nearest[x, y])
        along = np.asarray(dijkstra(graph, directed=False, indices=node))
        source = self.to_xy(np.array(divmod(node, self.blocked.shape[1])))
        # Only a goal off the free floor is replaced; within a cell the difference would be noise.
        apart = float(np.linalg.norm(source - goal, axis=-1)) if off[x, y] else 0.0
        # The centres of cells along x and y: the raster of all of them would be made anew for every goal.
        dx, dy = (
            (np.arange(count) + 0.5) * self.cell + start - at
            for count, start, at in zip(
                self.blocked.shape, self.origin, goal, strict=True
            )
        )
        straight = np.sqrt((dx * dx)[:, None] + dy * dy)
        # No path is shorter than the straight line; near the goal, centres of cells could suggest one.
        field = np.maximum(along[nearest] + off + apart, straight)
        # Read-only, because all who ask share it.
        return _frozen(field.astype(np.float32))

    def places(self, radius: float) -> np.ndarray:
        """Return the centres (P, 2) [m] of the cells of `navigable` for a ``radius`` [m]; read-only and cached."""
        return self._derived.get(
            ("places", radius),
            lambda: _frozen(self.to_xy(np.argwhere(self.navigable(radius)))),
        )

    @cached_property
    def _fields(self) -> MemoryCache:
        return MemoryCache("distance fields", MAX_KEPT_FIELDS)

    @cached_property
    def _derived(self) -> MemoryCache:
        return MemoryCache("maps")

    @property
    def _ways(self) -> tuple[csr_matrix, np.ndarray, np.ndarray]:
        return self._derived.get("ways", self._find_ways)

    def _find_ways(self) -> tuple[csr_matrix, np.ndarray, np.ndarray]:
        """Graph of the navigable cells; the node (X, Y) nearest to every cell, and its distance (X, Y) [m]."""
        free = self.navigable()
        if not free.any():
            raise UsageError(
                f"no floor on which a base of radius {NAVMESH_BASE_RADIUS_M} m can stand: nothing leads anywhere."
            )
        off, nearest = distance_transform_edt(~free, return_indices=True)  # type: ignore[misc]
        return (
            grid_graph(free, self.cell, SIXTEEN),
            np.asarray(np.ravel_multi_index(tuple(np.asarray(nearest)), free.shape)),
            np.asarray(off) * self.cell,
        )

    def sample(self, rng: np.random.Generator, mask: np.ndarray) -> np.ndarray:
        """Sample a position (2,) [m] uniformly in the cells of ``mask`` (X, Y) bool.

        Raises:
            ValueError: the mask is empty.
        """
        cells = np.argwhere(mask)
        if len(cells) == 0:
            raise ValueError("no cell to draw from: the mask is empty")
        return self.to_xy(cells[rng.integers(len(cells))] + rng.uniform(-0.5, 0.5, 2))


def _frozen(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array


def look_up(
    fields: np.ndarray,
    origin: np.ndarray,
    cell: np.ndarray,
    shape: np.ndarray,
    xy: np.ndarray,
) -> np.ndarray:
    """Interpolate distance fields bilinearly, one position in each.

    Args:
        fields: (W, X, Y) distances [m], padded to a common size.
        origin: (W, 2) position of each field's corner [m].
        cell: (W,) edge of its cells [m].
        shape: (W, 2) number of its cells that are used.
        xy: (W, 2) positions [m].

    Returns:
        (W,) distances [m]; outside of a field, that at its border plus the distance to the border.
    """
    last = shape - 1
    wanted = (xy - origin) / cell[:, None] - 0.5
    at = np.clip(wanted, 0.0, last)
    # At the last row the cell before it: the pair to interpolate between must exist.
    low = np.minimum(at.astype(int), np.maximum(last - 1, 0))
    (i, j) = low.T
    (k, m) = np.minimum(low + 1, last).T
    (u, v) = (at - low).T
    w = np.arange(len(fields))
    # The distance past the edge is added, so that a base outside of the raster does not seem nearer.
    near, far = ((1 - v) * fields[w, row, j] + v * fields[w, row, m] for row in (i, k))
    return (1 - u) * near + u * far + np.linalg.norm(wanted - at, axis=1) * cell


def shared_map(home: Home, pack: Pack) -> FreeMap:
    """Return `free_map` of a home at the default cell, cached in the pack."""
    # The home is stored with its map, so that its id is not reused.
    return pack.derived.get(id(home), lambda: (home, free_map(home, pack)))[1]


def free_map(home: Home, pack: Pack, cell: float = 0.05) -> FreeMap:
    """Compute the occupancy grid and clearance of a home.

    Args:
        home: the home.
        pack: its pack, which has the templates and meshes.
        cell: edge of a cell [m].
    """
    x0, y0, x1, y1 = home.floor
    origin = (x0 - _BORDER_M, y0 - _BORDER_M)
    shape = tuple(
        # A length that is a whole number of cells, up to rounding, gets no further cell.
        int(np.ceil((hi - lo + 2 * _BORDER_M) / cell - 1e-9))
        for lo, hi in ((x0, x1), (y0, y1))
    )
    blocked = np.zeros(shape, bool)
    _fill(blocked, blocking_polygons(home, pack), np.array(origin), cell)
    xs = origin[0] + (np.arange(shape[0]) + 0.5) * cell
    ys = origin[1] + (np.arange(shape[1]) + 0.5) * cell
    # Outside of the floor nobody can drive, even where no wall is modelled.
    blocked |= ~(((xs > x0) & (xs < x1))[:, None] & ((ys > y0) & (ys < y1))[None, :])
    clearance = np.maximum(
        # Distances go between centres, and an obstacle begins half a cell before its centre.
        np.asarray(distance_transform_edt(~blocked)) * cell - cell / 2,
        0.0,
    )
    return FreeMap(origin, cell, blocked, clearance)


@dataclass(frozen=True)
class Reach:
    """Planar distance of a receptacle from the nearest navigable cell [m].

    thing: name of the template. receptacle: its name. center, farthest: distance of its centre and of its farthest
    point, infinite if no cell is navigable. height: of its surface above the floor [m].
    """

    thing: str
    receptacle: str
    center: float
    farthest: float
    height: float


def reach(
    home: Home, pack: Pack, free: FreeMap, radius: float = NAVMESH_BASE_RADIUS_M
) -> list[Reach]:
    """Compute the planar distance from the floor navigable with ``radius`` [m] to every receptacle, drawers closed."""
    cells = np.argwhere(free.navigable(radius))
    stand = KDTree(free.to_xy(cells)) if len(cells) else None
    result = []
    for placement in (*home.props, *home.articulations):
        template = (
            pack.props.get(placement.template) or pack.articulations[placement.template]
        )
        origins = (
            {}
            if isinstance(template, Prop)
            else {link.name: link.pos for link in template.links}
        )
        for r in template.receptacles:
            ox, oy, oz = origins.get(r.link, (0.0, 0.0, 0.0))
            x = r.pos[0] + ox
            y = r.pos[1] + oy
            z = r.pos[2] + oz
            a, b, _, d = rectangle(
                placement, (x - r.half[0], x + r.half[0]), (y - r.half[1], y + r.half[1])
            )
            u, v = np.meshgrid(np.linspace(0.0, 1.0, 5), np.linspace(0.0, 1.0, 7))
            grid = a + u.ravel()[:, None] * (b - a) + v.ravel()[:, None] * (d - a)
            # Without floor to stand on everything is out of reach.
            far = np.full(len(grid) + 1, np.inf)
            if stand is not None:
                far = np.asarray(stand.query(np.vstack([(b + d) / 2, grid]))[0])
            farthest = float(far[1:].max())
            result.append(Reach(placement.template, r.name, float(far[0]), farthest, z))
    return result


def _fill(
    blocked: np.ndarray, polygons: Sequence[np.ndarray], origin: np.ndarray, cell: float
) -> None:
    """Set the cells of ``blocked`` (X, Y) whose square overlaps a convex counter-clockwise polygon (N, 2) [m].

    A home has some 170 polygons of mostly four corners and a few hundred cells: those of as many corners go together.
    """
    by_corners: dict[int, list[np.ndarray]] = {}
    for polygon in polygons:
        by_corners.setdefault(len(polygon), []).append(polygon)
    for alike in by_corners.values():
        _fill_alike(blocked, np.stack(alike), origin, cell)


def _fill_alike(
    blocked: np.ndarray, polygons: np.ndarray, origin: np.ndarray, cell: float
) -> None:
    """`_fill` for polygons (P, N, 2) of one number of corners."""
    low = np.floor((polygons.min(1) - origin) / cell).astype(int).clip(0, blocked.shape)
    high = np.ceil((polygons.max(1) - origin) / cell - 1e-9).astype(int)
    size = np.maximum(high.clip(0, blocked.shape) - low, 0)
    # The cells of all bounding rectangles in a row; ``own``: number of the polygon, ``at``: position in its rectangle.
    cells = size[:, 0] * size[:, 1]
    own = np.repeat(np.arange(len(polygons)), cells)
    at = np.arange(len(own)) - np.repeat(np.cumsum(cells) - cells, cells)
    i = low[own, 0] + at // size[own, 1]
    j = low[own, 1] + at % size[own, 1]
    x = origin[0] + (i + 0.5) * cell
    y = origin[1] + (j + 0.5) * cell
    inside = np.ones(len(own), bool)
    ends = np.roll(polygons, -1, axis=1)
    for a, b in zip(polygons.swapaxes(0, 1), ends.swapaxes(0, 1), strict=True):
        normal = np.stack([b[:, 1] - a[:, 1], a[:, 0] - b[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        # A square reaches this far towards an edge; cells that only touch the polygon stay free.
        slack = cell / 2 * np.abs(normal).sum(axis=1) - 1e-9
        away = (x - a[own, 0]) * normal[own, 0] + (y - a[own, 1]) * normal[own, 1]
        inside &= away < slack[own]
    blocked[i[inside], j[inside]] = True
