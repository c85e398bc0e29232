"""Where a mobile base can be: a raster of what blocks it and the distance to the nearest block.

Made from the scene description alone, without a simulator: every colliding geom between the floor and the
height of the robot is drawn as the convex outline of its points, doors and drawers in their closed pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import distance_transform_edt, label
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import ConvexHull, KDTree

from mjhab.core.errors import UsageError
from mjhab.core.grids import SIXTEEN, grid_graph
from mjhab.core.memory_cache import MemoryCache
from mjhab.core.rotations import mat_from_quat
from mjhab.scenes.shapes.footprints import all_geoms, outline, rectangle
from mjhab.scenes.spec import IDENTITY, Articulation, Geom, Home, Pack, Placement, Prop

NAVMESH_BASE_RADIUS_M = 0.3
"""Radius [m] of the robot for which HAB makes its navigation meshes."""
ROBOT_HEIGHT_M = 1.4
"""What hangs above this [m] does not block the base; the head camera of the benchmark's robot is at 1.41 m."""
MAX_KEPT_FIELDS = 4
"""Distance fields a map remembers; one of an apartment takes about 0.2 MB."""
_BORDER_M = 0.3
"""Border around the floor that the raster covers, so that outer walls are in it [m]."""


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
        """Cells (X, Y) bool where a disc of ``radius`` [m] fits, in the largest connected piece of them."""
        fits = self.clearance >= radius
        pieces = np.empty(fits.shape, np.int32)
        label(fits, structure=np.ones((3, 3)), output=pieces)
        if not fits.any():
            return fits
        sizes = np.bincount(pieces.ravel())
        sizes[0] = 0
        return pieces == sizes.argmax()

    def to_cell(self, xy: np.ndarray) -> np.ndarray:
        """Cell indices (..., 2) int of world positions (..., 2) [m], clipped to the raster."""
        index = np.floor((np.asarray(xy, float) - np.array(self.origin)) / self.cell).astype(int)
        return np.clip(index, 0, np.array(self.blocked.shape) - 1)

    def to_xy(self, cells: np.ndarray) -> np.ndarray:
        """World positions (..., 2) [m] of the centres of cells (..., 2)."""
        return (np.asarray(cells) + 0.5) * self.cell + np.array(self.origin)

    def clearance_at(self, xy: np.ndarray) -> np.ndarray:
        """Clearance (...,) [m] at world positions (..., 2); 0 outside the raster."""
        index = np.floor((np.asarray(xy, float) - np.array(self.origin)) / self.cell).astype(int)
        inside = np.all((index >= 0) & (index < np.array(self.blocked.shape)), axis=-1)
        index = np.clip(index, 0, np.array(self.blocked.shape) - 1)
        return np.where(inside, self.clearance[index[..., 0], index[..., 1]], 0.0)

    def distances_to(self, xy: np.ndarray) -> np.ndarray:
        """Length (X, Y) float32 [m] of the shortest way of the base from every cell to ``xy`` (2,).

        Ways lead through cells where a base of `NAVMESH_BASE_RADIUS_M` fits; they are up to 3 % longer than the true
        ones, and begin at a cell's centre. A place where the base does not fit, as start or as goal, counts as the
        nearest one where it does, and the straight line to there is added: every cell has a finite distance.
        Read-only; the last `MAX_KEPT_FIELDS` goals are remembered.

        Raises:
            UsageError: the base fits nowhere.
        """
        goal = np.asarray(xy, float)[:2]
        key = (round(float(goal[0]), 3), round(float(goal[1]), 3))
        return self._fields.get(key, lambda: self._field(goal))

    def distance(self, a: np.ndarray, b: np.ndarray) -> float:
        """Length [m] of the shortest way of the base between ``a`` and ``b`` (2,), as `distances_to` has it."""
        field = self.distances_to(b)[None]
        origin = np.array([self.origin])
        cell = np.array([self.cell])
        return float(
            look_up(
                field, origin, cell, np.array([field.shape[1:]]), np.asarray(a, float)[None, :2]
            )[0]
        )

    def _field(self, goal: np.ndarray) -> np.ndarray:
        graph, nearest, off = self._ways
        x, y = self.to_cell(goal)
        source = nearest[:, x, y]
        node = int(source[0] * self.blocked.shape[1] + source[1])
        along = np.asarray(dijkstra(graph, directed=False, indices=node)).reshape(
            self.blocked.shape
        )
        straight = np.linalg.norm(
            self.to_xy(np.moveaxis(np.indices(self.blocked.shape), 0, -1)) - goal, axis=-1
        )
        apart = float(np.linalg.norm(self.to_xy(source) - goal)) if off[x, y] else 0.0
        field = np.maximum(along[nearest[0], nearest[1]] + off + apart, straight).astype(np.float32)
        return _frozen(field)

    def places(self, radius: float) -> np.ndarray:
        """(P, 2) centres [m] of the cells of `navigable` for a ``radius`` [m]. Read-only."""
        return self._derived.get(
            ("places", radius), lambda: _frozen(self.to_xy(np.argwhere(self.navigable(radius))))
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
        """Graph of the navigable cells; the nearest of them (2, X, Y) to every cell and how far off it is [m]."""
        free = self.navigable()
        if not free.any():
            raise UsageError(
                f"no floor on which a base of radius {NAVMESH_BASE_RADIUS_M} m can stand: nothing leads anywhere."
            )
        off, nearest = distance_transform_edt(~free, return_indices=True)  # type: ignore[misc]
        return (
            grid_graph(free, self.cell, SIXTEEN),
            np.asarray(nearest),
            np.asarray(off) * self.cell,
        )

    def sample(self, rng: np.random.Generator, mask: np.ndarray) -> np.ndarray:
        """A uniform position (2,) [m] in the cells of ``mask`` (X, Y).

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
    fields: np.ndarray, origin: np.ndarray, cell: np.ndarray, shape: np.ndarray, xy: np.ndarray
) -> np.ndarray:
    """Values (W,) at positions ``xy`` (W, 2) [m], one in each of ``fields`` (W, X, Y).

    Args:
        origin: (W, 2) and cell: (W,) [m], of the raster of each field; shape: (W, 2) how many of its cells are used.

    Returns:
        Values between those of the four cells around; beyond the raster that of its border plus the distance to it.
    """
    last = shape - 1
    wanted = (xy - origin) / cell[:, None] - 0.5
    at = np.clip(wanted, 0.0, last)
    low = np.minimum(at.astype(int), np.maximum(last - 1, 0))
    (i, j) = low.T
    (k, m) = np.minimum(low + 1, last).T
    (u, v) = (at - low).T
    w = np.arange(len(fields))
    near, far = ((1 - v) * fields[w, row, j] + v * fields[w, row, m] for row in (i, k))
    return (1 - u) * near + u * far + np.linalg.norm(wanted - at, axis=1) * cell


def shared_map(home: Home, pack: Pack) -> FreeMap:
    """`free_map` of a home at its usual cell, drawn once for all who ask with the same pack."""
    # The home is kept with its map, so that no other home gets its id.
    return pack.derived.get(id(home), lambda: (home, free_map(home, pack)))[1]


def free_map(home: Home, pack: Pack, cell: float = 0.05) -> FreeMap:
    """Draw the raster of a home.

    Args:
        home: the home; pack: the pack it belongs to (templates and meshes).
        cell: edge of a cell [m].
    """
    x0, y0, x1, y1 = home.floor
    origin = (x0 - _BORDER_M, y0 - _BORDER_M)
    shape = tuple(
        int(np.ceil((hi - lo + 2 * _BORDER_M) / cell - 1e-9)) for lo, hi in ((x0, x1), (y0, y1))
    )
    blocked = np.zeros(shape, bool)
    for polygon in blocking_polygons(home, pack):
        _fill(blocked, polygon, origin, cell)
    xs = origin[0] + (np.arange(shape[0]) + 0.5) * cell
    ys = origin[1] + (np.arange(shape[1]) + 0.5) * cell
    blocked |= ~(((xs > x0) & (xs < x1))[:, None] & ((ys > y0) & (ys < y1))[None, :])
    clearance = np.maximum(np.asarray(distance_transform_edt(~blocked)) * cell - cell / 2, 0.0)
    return FreeMap(origin, cell, blocked, clearance)


def blocking_polygons(home: Home, pack: Pack) -> list[np.ndarray]:
    """Convex outlines (N, 2) [m] in the world of everything that blocks the base."""
    polygons = [
        _flatten(g, Placement("wall", (0.0, 0.0, 0.0)), pack) for g in home.walls if g.collide
    ]
    for placement in (*home.props, *home.articulations):
        template: Prop | Articulation
        if placement.template in pack.props:
            template = pack.props[placement.template]
            if not template.blocks_base:
                continue
        else:
            template = pack.articulations[placement.template]
        polygons += [_flatten(g, placement, pack) for g in all_geoms(template) if g.collide]
    return [p for p in polygons if p is not None]


def _flatten(geom: Geom, placement: Placement, pack: Pack) -> np.ndarray | None:
    """Outline of a geom on the floor, counter-clockwise, or None if it is above the robot."""
    if (
        geom.shape == "box" and geom.quat == IDENTITY and placement.quat is None
    ):  # most geoms, and no hull to find
        (x, y, z) = geom.pos
        (hx, hy, hz) = geom.size
        z += placement.pos[2]
        hidden = z - hz >= ROBOT_HEIGHT_M or z + hz <= 0.0
        return None if hidden else rectangle(placement, (x - hx, x + hx), (y - hy, y + hy))
    points = outline(geom, pack.meshes) @ mat_from_quat(np.array(placement.rotation)).T + np.array(
        placement.pos
    )
    if points[:, 2].min() >= ROBOT_HEIGHT_M or points[:, 2].max() <= 0.0:
        return None
    flat = np.unique(points[:, :2].round(9), axis=0)
    return flat[ConvexHull(flat).vertices]


@dataclass(frozen=True)
class Reach:
    """How far a receptacle is from where the base can stand: its centre, and its farthest point [m].

    height: of its surface above the floor [m].
    """

    thing: str
    receptacle: str
    center: float
    farthest: float
    height: float


def reach(
    home: Home, pack: Pack, free: FreeMap, radius: float = NAVMESH_BASE_RADIUS_M
) -> list[Reach]:
    """Planar distances [m] from navigable floor to every receptacle of a home, drawers closed, and its height."""
    cells = np.argwhere(free.navigable(radius))
    stand = KDTree(free.to_xy(cells)) if len(cells) else None
    result = []
    for placement in (*home.props, *home.articulations):
        template = pack.props.get(placement.template) or pack.articulations[placement.template]
        origins = (
            {} if isinstance(template, Prop) else {link.name: link.pos for link in template.links}
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
            far = np.full(len(grid) + 1, np.inf)
            if stand is not None:
                far = np.asarray(stand.query(np.vstack([(b + d) / 2, grid]))[0])
            farthest = float(far[1:].max())
            result.append(Reach(placement.template, r.name, float(far[0]), farthest, z))
    return result


def _fill(
    blocked: np.ndarray, polygon: np.ndarray, origin: tuple[float, float], cell: float
) -> None:
    """Mark the cells whose square meets a convex counter-clockwise polygon."""
    low = np.clip(np.floor((polygon.min(0) - origin) / cell).astype(int), 0, blocked.shape)
    high = np.clip(np.ceil((polygon.max(0) - origin) / cell - 1e-9).astype(int), 0, blocked.shape)
    if np.any(high <= low):
        return
    xs = origin[0] + (np.arange(low[0], high[0]) + 0.5) * cell
    ys = origin[1] + (np.arange(low[1], high[1]) + 0.5) * cell
    inside = np.ones((len(xs), len(ys)), bool)
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        normal = np.array([b[1] - a[1], a[0] - b[0]])
        slack = cell / 2 * np.abs(normal).sum() - 1e-9
        inside &= (xs[:, None] - a[0]) * normal[0] + (ys[None, :] - a[1]) * normal[1] < slack
    blocked[low[0] : high[0], low[1] : high[1]] |= inside
