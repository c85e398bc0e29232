"""Reader of Recast navigation meshes (``.navmesh``), of which ReplicaCAD has one per scene."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjhab.core.errors import fault

_SET_MAGIC = b"TESM"
_TILE_MAGIC = b"VAND"
_HEADER_BYTES = 100
"""Size of dtMeshHeader (Detour's DetourNavMesh.h)."""
_POLYGON_BYTES = 32
"""Size of dtPoly (Detour's DetourNavMesh.h)."""


@dataclass(frozen=True, eq=False)
class NavMesh:
    """A navigation mesh in our world axes (+z up).

    Attributes:
        bounds: x_min, y_min, x_max, y_max [m] of the scene that it was computed for.
        polygons: (N, 3) [m] each, corners of the convex walkable polygons, counter-clockwise seen from above.
    """

    bounds: tuple[float, float, float, float]
    polygons: list[np.ndarray]


def read_navmesh(path: Path) -> NavMesh:
    """Read a file with one tile.

    Raises:
        UsageError: it cannot be read or is not such a file; the message names it.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise fault(path, f"cannot be read ({error.strerror or error}).") from error
    tile = raw.find(_TILE_MAGIC)
    if raw[:4] != _SET_MAGIC or tile < 0:
        raise fault(path, "not a navigation mesh of one tile; download the file again.")
    try:
        x, _, z, width, depth = struct.unpack_from("<5f", raw, 12)
        polygon_count, vertex_count = struct.unpack_from("<2i", raw, tile + 24)
        start = tile + _HEADER_BYTES
        vertices = (
            np.frombuffer(raw, "<f4", 3 * vertex_count, start)
            .reshape(-1, 3)
            .astype(float)
        )
        polygons = []
        for k in range(polygon_count):
            record = struct.unpack_from(
                "<I6H6HH2B", raw, start + 12 * vertex_count + _POLYGON_BYTES * k
            )
            # A polygon has room for six corners, and says how many it uses.
            corners = vertices[list(record[1 : 1 + record[14]])]
            polygons.append(
                # From +y up to +z up, see `files`.
                np.stack([corners[:, 0], -corners[:, 2], corners[:, 1]], axis=1)
            )
    except (struct.error, ValueError, IndexError) as error:
        raise fault(path, f"cut off ({error}); download the file again.") from error
    return NavMesh((x, -(z + depth), x + width, -z), polygons)
