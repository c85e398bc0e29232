"""Render meshes of ReplicaCAD templates, read once and cached on disk."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mjhab.core.arithmetic.digest import arithmetic_digest
from mjhab.core.files.cache import cache_dir, read_cached, write_cached
from mjhab.core.files.code_digest import code_digest
from mjhab.scenes.formats.gltf import Primitive, read_glb
from mjhab.scenes.replica_cad.files import file_state
from mjhab.scenes.shapes.meshes import Mesh, mesh_arrays, mesh_from_arrays
from mjhab.scenes.shapes.painting import textured_mesh


@dataclass(eq=False)
class MeshFiles:
    """Collect the files that render meshes are made of; `meshes` reads them all."""

    wanted: dict[str, list[tuple[Path, np.ndarray]]] = field(default_factory=dict)

    def add(self, name: str, file: Path, pose: np.ndarray) -> None:
        """Add a file to the mesh ``name``; ``pose`` (4, 4) maps its points to the frame of the mesh."""
        self.wanted.setdefault(name, []).append((file, np.asarray(pose, float)))

    def meshes(self) -> dict[str, Mesh]:
        """Return all collected meshes by name, each from the cache if its files are unchanged.

        Raises:
            UsageError: a file is missing or broken; the message names it.
        """
        return {name: self._mesh(name) for name in self.wanted}

    def _mesh(self, name: str) -> Mesh:
        path = cache_dir() / "replica_cad" / f"look-{self._digest(name)}.npz"
        found = read_cached(path, lambda file: _load(file, name))
        if found is not None:
            return found
        made = textured_mesh(self._parts(name))
        arrays = mesh_arrays(name, made)
        # Not compressed, because decompressing textures takes longer than reading them.
        write_cached(
            path, lambda temporary: np.savez(temporary, allow_pickle=False, **arrays)
        )
        return made

    def _parts(self, name: str) -> list[Primitive]:
        parts = []
        for file, pose in self.wanted[name]:
            for part in read_glb(file):
                parts.append(
                    dataclasses.replace(
                        part, vertices=part.vertices @ pose[:3, :3].T + pose[:3, 3]
                    )
                )
        return parts

    def _digest(self, name: str) -> str:
        """Hash of the inputs: name, size and modification time of the files, poses, and the code of the readers."""
        readers = code_digest(
            "scenes.formats.gltf",
            "scenes.shapes.painting",
            "scenes.shapes.meshes",
            "scenes.shapes.winding",
        )
        # The code of the readers, because a change of it would else show only after the cache is cleared.
        digest = hashlib.sha256(readers + arithmetic_digest())
        for file, pose in self.wanted[name]:
            # Without the folder, so that a data set that was moved keeps its cache.
            state = (name, file.name, file_state(file))
            digest.update(repr(state).encode() + pose.round(9).tobytes())
        return digest.hexdigest()[:24]


def _load(path: Path, name: str) -> Mesh:
    with np.load(path, allow_pickle=False) as arrays:
        return mesh_from_arrays(name, arrays)
