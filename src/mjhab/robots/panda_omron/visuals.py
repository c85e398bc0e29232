"""Visual meshes of the Panda on the Omron base, from robosuite's files, simplified."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import trimesh

from mjhab.robots.meshes import coarse_mesh
from mjhab.robots.panda_omron.assets import robosuite_file
from mjhab.robots.panda_omron.geometry import BASE_LINK, CENTER_X, COLUMN, panda_files
from mjhab.scenes.shapes.meshes import Mesh

MAX_FACES = 2500
"""Largest number of faces of a mesh."""
WHEELBASE_POS = (CENTER_X - 0.20, 0.0, 0.192)
"""Position of the platform's mesh frame in the base frame [m]."""
_OMRON = {
    0: "panda_grey",
    1: "omron_dark",
    2: "omron_grey",
    3: "panda_grey",
    4: "omron_grey",
    5: "panda_white",
    6: "omron_grey",
    7: "omron_dark",
}
"""Material by number of the platform's mesh, close to the colours of ``bases/omron_mobile_base.xml``."""
_GREY_LINKS = ("leftfinger", "rightfinger")


@lru_cache(maxsize=1)
def robot_meshes() -> list[tuple[str, Mesh, str]]:
    """Return the visual meshes: (body name, mesh in that body's frame [m], material name).

    Those of the arm are robosuite's collision meshes, which have its shape with few triangles.

    Raises:
        MjhabError: robosuite is not installed.
    """
    parts: list[tuple[str, Mesh, str]] = []
    for number, material in _OMRON.items():
        file = robosuite_file(f"bases/meshes/omron_mobile_base/omron_{number}.obj")
        # Merging vertices would be done twice: `coarse_mesh` does it.
        loaded = trimesh.load_mesh(file, process=False)
        vertices = np.asarray(loaded.vertices) + WHEELBASE_POS
        parts.append(
            (
                BASE_LINK,
                coarse_mesh(vertices, np.asarray(loaded.faces), MAX_FACES),
                material,
            )
        )
    for part in panda_files().meshes(group=0):
        loaded = trimesh.load_mesh(part.file)
        vertices = np.asarray(loaded.vertices) @ part.rot.T + part.pos
        mesh = coarse_mesh(vertices, np.asarray(loaded.faces), MAX_FACES)
        parts.append(
            (part.link, mesh, "panda_grey" if part.link in _GREY_LINKS else "panda_white")
        )
    return parts + _column()


def _column() -> list[tuple[str, Mesh, str]]:
    """Return meshes of the two tubes of the lifting column, which are primitives in the files."""
    tubes = (
        (BASE_LINK, (CENTER_X - 0.05, 0.0, 0.50), 0.12),
        (COLUMN, (-0.05, 0.0, -0.20), 0.1125),
    )
    parts = []
    for link, middle, radius in tubes:
        tube = trimesh.creation.cylinder(radius, 0.4, sections=32)
        vertices = (tube.vertices + np.array(middle)).astype(np.float32)
        parts.append((link, Mesh(vertices, tube.faces.astype(np.int32)), "panda_white"))
    return parts
