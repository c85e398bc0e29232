"""Where the navigation meshes of ReplicaCAD's scenes say that someone can walk, as a raster."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt

from mjhab.core.errors import fault
from mjhab.scenes.replica_cad.files import NAVMESHES, file_state
from mjhab.scenes.replica_cad.navmesh import NavMesh, read_navmesh

AGENT_RADIUS_M = 0.1
"""Distance that these meshes keep from whatever stood in the scene, rounded up to their cells of 5 cm [m]."""
MAX_FLOOR_HEIGHT_M = 0.25
"""Polygons that rise higher are stairs or tops of furniture [m]; those of the floor lie at 0.10 to 0.15."""
CELL_M = 0.025
"""Edge of a cell of the raster [m]: half of one of the meshes, whose corners lie on corners of cells."""
_MARGIN_M = 0.5
"""Margin of the raster around the bounds of the meshes [m]."""


@dataclass(frozen=True, eq=False)
class Walkable:
    """Walkable floor: cell (i, j) is the square at ``origin`` + (i, j) * `CELL_M` [m]; ``mask`` (X, Y) bool."""

    origin: np.ndarray
    mask: np.ndarray

    @cached_property
    def far(self) -> np.ndarray:
        """Distance (X, Y) [m] of every cell's centre from the walkable floor; 0 on it."""
        away = np.asarray(distance_transform_edt(~self.mask)) * CELL_M
        # Distances go between centres of cells, and floor begins half a cell before its centre.
        return np.maximum(away - CELL_M / 2, 0.0)

    def distance(self, xy: np.ndarray) -> np.ndarray:
        """Look up the distance (...) [m] of positions (..., 2) [m] from the walkable floor, good to a cell."""
        cells = np.floor((xy - self.origin) / CELL_M).astype(int)
        # Past the margin the cell at the edge is far enough from everything.
        cells = np.clip(cells, 0, np.array(self.mask.shape) - 1)
        return self.far[cells[..., 0], cells[..., 1]]

    def centers(self) -> np.ndarray:
        """Return the centres (X, Y, 2) [m] of the cells."""
        indices = np.moveaxis(np.indices(self.mask.shape), 0, -1)
        return self.origin + (indices + 0.5) * CELL_M


def walkable_floor(folder: Path, scenes: Iterable[str]) -> Walkable:
    """Draw the floor that is walkable in any of some scenes of one stage.

    What furniture covers in one scene is free in another, so that what is left are walls.

    Raises:
        UsageError: a scene has no navigation mesh in `files.NAVMESHES`, or its file is broken.
    """
    files = [folder / NAVMESHES / f"{name}.navmesh" for name in scenes]
    if not files:
        raise fault(folder, "no scene whose stage is missing.")
    return _drawn(tuple((file, file_state(file)) for file in files))


@lru_cache(maxsize=1)
def _drawn(files: tuple[tuple[Path, tuple[int, int]], ...]) -> Walkable:
    """The floor of files of these sizes and times: that of all packs of a data set."""
    meshes = [read_navmesh(file) for file, _ in files]
    bounds = np.array([mesh.bounds for mesh in meshes])
    low = bounds[0, :2]
    # Corners of cells of the first mesh; those of one stage have the same bounds.
    origin = low + np.floor((bounds[:, :2].min(0) - low - _MARGIN_M) / 0.05) * 0.05
    size = (bounds[:, 2:].max(0) + _MARGIN_M - origin) / CELL_M
    mask = np.zeros(np.ceil(size).astype(int), bool)
    for mesh in meshes:
        for corners in _floor_polygons(mesh):
            fill(mask, origin, corners)
    return Walkable(origin, mask)


def _floor_polygons(mesh: NavMesh) -> list[np.ndarray]:
    return [p[:, :2] for p in mesh.polygons if p[:, 2].max() < MAX_FLOOR_HEIGHT_M]


def fill(mask: np.ndarray, origin: np.ndarray, corners: np.ndarray) -> None:
    """Set the cells of ``mask`` (X, Y) whose centres lie in a convex polygon (N, 2) [m]."""
    low = np.floor((corners.min(0) - origin) / CELL_M).astype(int)
    high = np.ceil((corners.max(0) - origin) / CELL_M).astype(int)
    low = np.clip(low, 0, mask.shape)
    high = np.clip(high, 0, mask.shape)
    if np.any(high <= low):
        return
    x = origin[0] + (np.arange(low[0], high[0])[:, None] + 0.5) * CELL_M
    y = origin[1] + (np.arange(low[1], high[1])[None, :] + 0.5) * CELL_M
    left = np.ones((high[0] - low[0], high[1] - low[1]), bool)
    right = left.copy()
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        side = (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
        left &= side >= -1e-9
        right &= side <= 1e-9
    # Polygons may be wound either way.
    mask[low[0] : high[0], low[1] : high[1]] |= left | right
