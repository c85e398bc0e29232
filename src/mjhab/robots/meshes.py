"""Visual meshes of robots: coarsened to be drawn in many worlds, or made from collision shapes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import trimesh

from mjhab.core.rotations import mat_from_quat
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import Geom

_CELL_M = 0.004


def coarse_mesh(vertices: np.ndarray, faces: np.ndarray, most_faces: int) -> Mesh:
    """Simplify a mesh: merge vertices on a grid that is coarsened until at most ``most_faces`` faces are left.

    Args:
        vertices: (V, 3) positions [m].
        faces: (F, 3) indices of vertices.
        most_faces: largest number of faces.

    Returns:
        The simplified mesh; a mesh with few enough faces unchanged.
    """
    cell = _CELL_M
    kept = vertices
    triangles = faces
    while len(triangles) > most_faces:
        _, index, inverse = np.unique(
            # A vertex of the mesh stands for its cell: the middle would move edges off the surface.
            np.round(vertices / cell),
            axis=0,
            return_index=True,
            return_inverse=True,
        )
        kept = vertices[index]
        # Always from the original, so that errors of the coarser grids do not add up.
        triangles = inverse.ravel()[faces]
        a, b, c = triangles.T
        # Triangles that shrink to a line are not seen, and cost the rasterizer time.
        triangles = np.unique(triangles[(a != b) & (b != c) & (a != c)], axis=0)
        # By a quarter: doubling would overshoot the number of faces far.
        cell *= 1.25
    return Mesh(kept.astype(np.float32), triangles.astype(np.int32))


def meshes_of_shapes(
    collision: Mapping[str, tuple[Geom, ...]], material: str
) -> list[tuple[str, Mesh, str]]:
    """Return visual meshes made from collision shapes.

    Args:
        collision: shapes by link, as in `Body.collision`.
        material: name of one of the robot's materials, for all meshes.

    Returns:
        (link, mesh in the frame of the link [m], material) of every shape.
    """
    parts = []
    for link, geoms in collision.items():
        for geom in geoms:
            solid = _solid(geom)
            rot = mat_from_quat(np.array(geom.quat))
            vertices = np.asarray(solid.vertices) @ rot.T + np.array(geom.pos)
            mesh = Mesh(vertices.astype(np.float32), np.asarray(solid.faces, np.int32))
            parts.append((link, mesh, material))
    return parts


def _solid(geom: Geom) -> trimesh.Trimesh:
    radius, half, _ = geom.size
    if geom.shape == "box":
        return trimesh.creation.box(2.0 * np.array(geom.size))
    if geom.shape == "cylinder":
        # As many sides as the prism that collides (`model.PRISM_SIDES`).
        return trimesh.creation.cylinder(radius, 2.0 * half, sections=24)
    if geom.shape == "capsule":
        return trimesh.creation.capsule(2.0 * half, radius, count=[12, 12])
    return trimesh.creation.uv_sphere(radius, count=[12, 12])
