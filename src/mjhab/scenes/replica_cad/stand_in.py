"""A stage for ReplicaCAD scenes whose own is missing: a like mesh, fitted to the navigation meshes of the scenes.

The stages of the 84 staged scenes are not in every copy of the data. `stage_choice.STAND_IN_FILE`, the shell of the
same apartment, has their frame and nearly their walls. What differs is known from the navigation meshes, which were
computed in the real stages. All of them have the same bounds and end at the same walls in all four macro layouts; so
the scenes have one shell, and what is walkable in one of them has no wall in any.

- Cut: a wall nearer than `CLEAR_M` to walkable floor is not there. The outer walls of the real stages are thinner:
  their inner faces lie 7 to 15 cm farther out at x = 0.34, at x = 4.40 and at y = -4.12 (beside the fridge of sc3).
- Closed: the mesh has neither windows nor doors. A wall stands along the whole edge of its floor.
- Stairs: where nobody walks in any scene for more than `VOID_M` around, the real stage has a flight of stairs (polygons
  of the navigation meshes rise there from 0.1 to 1.1 m, at x = 1.3 to 3.5, y = 0.8 to 2.6), and the mesh bare floor. A
  block of the height `BLOCK_HEIGHT_M` fills it.

The wall beside the fridge of ``v3_sc3``: the navigation meshes of all 84 scenes end at y = -4.09 for a radius of 0.1 m
and at y = -3.89 for 0.3 m; so the wall begins in the cell from y = -4.19 to -4.24. There the upper door of the fridge
(0 .. 2.30 rad) opens to 1.72 .. 1.795 rad. Here the face of the wall is at y = -4.212, that of the mesh's outer wall,
and the door opens to 1.75 rad; by the mesh's inner wall, to 1.62. Open asks for 1.725. Published rates fit: in the val
split opening works (88 %) and closing, which starts between 1.725 and 2.30, never does (0 %). They prove nothing: in
MS-HAB doors pass through the stage.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import label

from mjhab.core.errors import fault
from mjhab.scenes.formats.gltf import TO_Z_UP
from mjhab.scenes.replica_cad.stage import (
    MATERIAL,
    WALL_DEPTH_M,
    Extent,
    merge_cells,
    shape_of,
    stage_triangles,
)
from mjhab.scenes.replica_cad.walkable import CELL_M, Walkable, fill, walkable_floor
from mjhab.scenes.shapes.footprints import outline
from mjhab.scenes.spec import Geom

CLEAR_M = 0.05
"""Walls nearer than this to walkable floor are cut [m]: half of what the meshes keep. They round up to cells of 5 cm,
but simplify their contours by up to 1.3 cells, so that a wall may be as near as 3.5 cm where it is right."""
AGENT_HEIGHT_M = 1.5
"""Height of the agent of the navigation meshes [m] (habitat-sim's default); walls above, such as lintels, stay."""
VOID_M = 0.3
"""Where floor is farther than this from all that is walkable [m], something stands: walls are thinner."""
MIN_VOID_M2 = 0.5
BLOCK_HEIGHT_M = 1.1
"""Height of the block in place of the stairs [m]: that to which the navigation meshes follow them."""
MAX_CROSSING_M2 = 0.25
"""Largest area of walls on walkable floor [m^2] of a mesh in the frame of the scenes: that of the data set has 0.14,
and shifted by 10 cm along an axis at least 0.27."""
_SECTION_M = 0.01
"""Length of the pieces in which walls are cut [m]."""
_MIN_PIECE_M = 0.03
_BLOCK_CELLS = 4
"""The block is made of squares of so many cells."""
_GAP_M = 0.1
"""Distance of the block from walkable floor [m]."""


def stand_in(
    file: Path, folder: Path, scenes: Sequence[str]
) -> tuple[tuple[Geom, ...], Extent]:
    """Compute walls and floor extent of a stand-in for the stages of some scenes.

    Args:
        file: its mesh.
        folder: of the data set.
        scenes: all scenes of the data set whose stage is missing, whether they are opened or not: they share one
            stage, and a home does not depend on which others are opened.

    Returns:
        Wall boxes in our world axes, and x_min, y_min, x_max, y_max of the floor [m].

    Raises:
        UsageError: a file is missing or broken, or the mesh is in another frame: its walls stand on walkable floor.
    """
    triangles = stage_triangles(file) @ TO_Z_UP.T
    walls, extent = shape_of(triangles)
    floor = walkable_floor(folder, scenes)
    # Before any wall is cut: of a mesh in another frame nearly nothing would be left, without an error.
    _check_frame(file, walls, floor)
    top = float(triangles[..., 2].max())
    shell = _shell(triangles, top)
    kept = [piece for wall in walls for piece in _cut(wall, floor)]
    # Two boxes in one place would flicker in images, and double every contact.
    inside = [wall for wall in kept if not any(_covers(box, wall) for box in shell)]
    return (*shell, *inside, *_block(triangles, extent, floor)), extent


def crossing_area(walls: Sequence[Geom], floor: Walkable) -> float:
    """Compute the area [m^2] of walls below `AGENT_HEIGHT_M` that stands on walkable floor."""
    total = 0.0
    for wall in walls:
        if _is_low(wall):
            points = _sections(wall)
            total += (
                4 * wall.size[0] * wall.size[1] * (floor.distance(points) <= 0).mean()
            )
    return total


def _check_frame(file: Path, walls: Sequence[Geom], floor: Walkable) -> None:
    crossing = crossing_area(walls, floor)
    if crossing > MAX_CROSSING_M2:
        raise fault(
            file,
            f"{crossing:.2f} m^2 of its walls stand on floor that the navigation meshes of the scenes call "
            f"walkable, expected at most {MAX_CROSSING_M2:g} m^2: it is no stage in their frame, and its walls would "
            "run through rooms and furniture. Give another with --stage-mesh, or --stage none.",
        )


def _is_low(wall: Geom) -> bool:
    # Only what the agent would meet can contradict a navigation mesh.
    return wall.pos[2] - wall.size[2] < AGENT_HEIGHT_M and wall.pos[2] + wall.size[2] > 0


def _axes(wall: Geom) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal unit axes (2,) of a wall box: across and along it."""
    yaw = 2 * math.atan2(wall.quat[3], wall.quat[0])
    across = np.array([np.cos(yaw), np.sin(yaw)])
    return across, np.array([-across[1], across[0]])


def _sections(wall: Geom) -> np.ndarray:
    """Points (N, 5, 2) [m] of the plan of a wall, in N sections across it."""
    across, along = _axes(wall)
    count = max(int(2 * wall.size[1] / _SECTION_M), 1)
    middles = ((np.arange(count) + 0.5) / count * 2 - 1) * wall.size[1]
    depth = np.linspace(-1, 1, 5) * wall.size[0]
    return (
        np.array(wall.pos[:2])
        + middles[:, None, None] * along
        + depth[None, :, None] * across
    )


def _cut(wall: Geom, floor: Walkable) -> list[Geom]:
    """Pieces of a wall that keep `CLEAR_M` from walkable floor."""
    if not _is_low(wall):
        return [wall]
    stays = np.all(floor.distance(_sections(wall)) >= CLEAR_M, axis=1)
    # The wall itself, so that most walls stay one box.
    if stays.all():
        return [wall]
    _, along = _axes(wall)
    step = 2 * wall.size[1] / len(stays)
    edges = np.flatnonzero(np.diff(np.r_[0, stays.astype(np.int8), 0]))
    pieces = []
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        half = (end - first) * step / 2
        if 2 * half < _MIN_PIECE_M:
            continue
        at = np.array(wall.pos[:2]) + along * ((first + end) * step / 2 - wall.size[1])
        pieces.append(
            Geom(
                "box",
                (wall.size[0], half, wall.size[2]),
                (float(at[0]), float(at[1]), wall.pos[2]),
                wall.quat,
                wall.material,
            )
        )
    return pieces


def _floor_triangles(triangles: np.ndarray) -> np.ndarray:
    """Corners (T, 3, 2) [m], to the millimetre, of the triangles of the floor: level, facing up, below 10 cm."""
    normal = np.cross(
        triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    )
    size = np.linalg.norm(normal, axis=1)
    level = normal[:, 2] > 0.99 * np.maximum(size, 1e-12)
    low = np.abs(triangles[..., 2]).max(axis=1) < 0.1
    # Rounded, because edges of neighbours are compared for equality.
    return triangles[level & low][..., :2].round(3)


def _shell(triangles: np.ndarray, top: float) -> list[Geom]:
    """Walls along the edge of the floor, from the floor to ``top`` [m], inside of it."""
    edges = [
        (tuple(t[k].tolist()), tuple(t[(k + 1) % 3].tolist()))
        for t in _floor_triangles(triangles)
        for k in range(3)
    ]
    # An edge inside of the floor belongs to two triangles, in opposite directions.
    outer = [(a, b) for a, b in edges if (b, a) not in edges]
    return [_panel(np.array(a), np.array(b), top) for a, b in outer]


def _panel(a: np.ndarray, b: np.ndarray, top: float) -> Geom:
    """Wall from ``a`` to ``b`` (2,) [m], to the left of this line."""
    along = (b - a) / np.linalg.norm(b - a, axis=-1)
    inward = np.array([-along[1], along[0]])
    middle = (a + b) / 2 + inward * WALL_DEPTH_M / 2
    yaw = math.atan2(inward[1], inward[0])
    size = (WALL_DEPTH_M / 2, float(np.linalg.norm(b - a, axis=-1)) / 2, top / 2)
    quat = (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))
    return Geom(
        "box", size, (float(middle[0]), float(middle[1]), top / 2), quat, MATERIAL
    )


def _covers(panel: Geom, wall: Geom) -> bool:
    """Whether a wall lies in a panel of the shell, to 2 cm."""
    across, along = _axes(panel)
    offset = outline(wall)[:, :2] - np.array(panel.pos[:2])
    deep = np.abs(offset @ across) <= panel.size[0] + 0.02
    wide = np.abs(offset @ along) <= panel.size[1] + 0.02
    return bool(np.all(deep & wide))


def _block(triangles: np.ndarray, extent: Extent, floor: Walkable) -> list[Geom]:
    """Boxes where nobody walks: in place of the stairs, and outside of the floor."""
    inside = np.zeros(floor.mask.shape, bool)
    for corners in _floor_triangles(triangles):
        fill(inside, floor.origin, corners)
    centers = floor.centers()
    within = np.all((centers > extent[:2]) & (centers < extent[2:]), axis=-1)
    pieces = np.empty(inside.shape, np.int32)
    label(inside & (floor.far > VOID_M), output=pieces)
    sizes = np.bincount(pieces.ravel()) * CELL_M**2
    # Label 0 is everything else.
    sizes[0] = 0.0
    core = np.isin(pieces, np.flatnonzero(sizes >= MIN_VOID_M2))
    around = Walkable(floor.origin, core)
    stairs = inside & (around.far < VOID_M - _GAP_M) & (floor.far > _GAP_M)
    region = stairs | (within & ~inside)
    rows, columns = (n // _BLOCK_CELLS for n in region.shape)
    # Cut to whole squares; the margin of the raster is empty.
    coarse = region[: rows * _BLOCK_CELLS, : columns * _BLOCK_CELLS]
    shape = (rows, _BLOCK_CELLS, columns, _BLOCK_CELLS)
    return [
        _box(floor.origin, cells)
        for cells in merge_cells(coarse.reshape(shape).all(axis=(1, 3)))
    ]


def _box(origin: np.ndarray, cells: tuple[int, int, int, int]) -> Geom:
    i0, i1, j0, j1 = cells
    edge = _BLOCK_CELLS * CELL_M
    low = origin + np.array([i0, j0]) * edge
    high = origin + np.array([i1, j1]) * edge
    x, y = ((low + high) / 2).tolist()
    half_x, half_y = ((high - low) / 2).tolist()
    half_z = BLOCK_HEIGHT_M / 2
    return Geom("box", (half_x, half_y, half_z), (x, y, half_z), material=MATERIAL)
