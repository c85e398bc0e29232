"""A cube of 6 cm as a file may bring it: wound inwards, at random, double-sided, mirrored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mjhab.scenes.object_glb import object_from_glb
from mjhab.scenes.objects import ObjectModel
from tests.scenes.formats.glb import BOX, BOX_FACES, write_glb

HALF_M = 0.03
_INWARD = BOX_FACES[:, ::-1]
_MIXED = np.where((np.arange(12) % 3 == 0)[:, None], _INWARD, BOX_FACES)
_MIRROR = [{"mesh": 0, "scale": [-1, 1, 1]}]
_TWICE = [
    {"scale": [1, -1, 1], "children": [1]},
    {"mesh": 0, "scale": [-1, -1, -1]},
]
_MATRIX = [{"mesh": 0, "matrix": [0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}]
CUBES: dict[str, dict[str, Any]] = {
    "good": {"faces": BOX_FACES},
    "inward": {"faces": _INWARD},
    "mixed": {"faces": _MIXED},
    "double": {"faces": BOX_FACES, "double_sided": True},
    "double_inward": {"faces": _INWARD, "double_sided": True},
    "double_mixed": {"faces": _MIXED, "double_sided": True},
    "mirrored": {"faces": BOX_FACES, "nodes": _MIRROR},
    "mirrored_inward": {"faces": _INWARD, "nodes": _MIRROR},
    "mirrored_in_mirrored": {"faces": BOX_FACES, "nodes": _TWICE},
    "mirroring_matrix": {"faces": BOX_FACES, "nodes": _MATRIX},
}
"""Ways to write the same cube."""


def cube(name: str, folder: Path) -> ObjectModel:
    """The object of one of `CUBES`, read from its file."""
    how = dict(CUBES[name])
    faces = how.pop("faces")
    # Every face has its own corners, as exporters write flat ones.
    corners = (BOX * HALF_M)[faces.ravel()]
    apart = np.arange(len(corners)).reshape(-1, 3)
    file = write_glb(folder / f"{name}.glb", [(corners, apart)], **how)
    return object_from_glb(f"{name}_cube", file, mass=0.2)
