"""Models as binary glTF files (GLB) for the browser, cached on disk."""

from __future__ import annotations

import functools
import hashlib
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import trimesh
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from mjhab.core.files.cache import cache_dir, write_cached
from mjhab.core.files.code_digest import code_digest
from mjhab.layout.compile import home_hash
from mjhab.layout.layout import Layout
from mjhab.render.models import DrawnHome, Look, Model
from mjhab.robots.robot import Robot
from mjhab.scenes.shapes.meshes import Mesh, mesh_arrays

JPEG = "JPEG"


@dataclass(frozen=True, eq=False)
class HomeFiles:
    """The models of one home as GLB files.

    Attributes:
        home: file of everything that does not move, in the world frame.
        movable: for each moving model the ids of the bodies that have it, and its file in the frame of the body.
        lamp_pos, lamp_color: (L, 3) [m], (L, 3) linear rgb times intensity.
    """

    home: bytes
    movable: tuple[tuple[tuple[int, ...], bytes], ...]
    lamp_pos: np.ndarray
    lamp_color: np.ndarray


def home_files(layout: Layout, home: str, make: Callable[[], DrawnHome]) -> HomeFiles:
    """Return the files of a home of a layout, from the cache on disk if it has them.

    Args:
        layout: has the home.
        home: name of the home.
        make: computes the models if the cache lacks them.
    """
    path = cache_dir() / "viewer" / f"{home_digest(layout, home)}.npz"
    found = _read(path)
    if found is None:
        models = make()
        found = HomeFiles(
            glb(models.home, models.looks),
            tuple((model.bodies, glb(model, models.looks)) for model in models.movable),
            models.lamp_pos,
            models.lamp_color,
        )
        arrays = _arrays(found)
        write_cached(
            path, lambda temporary: np.savez(temporary, allow_pickle=False, **arrays)
        )
    return found


def home_digest(layout: Layout, home: str) -> str:
    """Return a hash of everything that the files of a home of a layout depend on."""
    spec = next(h for h in layout.pack.homes if h.name == home)
    digest = hashlib.sha256(home_hash(layout, spec).encode())
    # A change of the code that draws must not show old files.
    digest.update(code_digest("viewer.drawn.glb", "render", "robots"))
    # The hash of the home covers only its physics: no colours, no textures, and not how the robot looks.
    digest.update(_looks_digest(layout.robot))
    for name, mesh in sorted(layout.pack.meshes.items()):
        digest.update(_mesh_bytes(name, cast(Mesh, mesh)))
    return digest.hexdigest()[:24]


@functools.cache
def _looks_digest(robot: Robot) -> bytes:
    """Hash of the visual meshes and materials of a robot."""
    digest = hashlib.sha256(repr(sorted(robot.materials.items())).encode())
    for link, mesh, material in robot.visuals():
        digest.update(_mesh_bytes(f"{link} {material}", mesh))
    return digest.digest()


def _mesh_bytes(name: str, mesh: Mesh) -> bytes:
    arrays = mesh_arrays(name, mesh)
    parts = (
        f"{key} {array.shape} {array.dtype}".encode() + array.tobytes()
        for key, array in arrays.items()
    )
    return b"".join(parts)


def _arrays(files: HomeFiles) -> dict[str, np.ndarray]:
    arrays = {
        "lamp_pos": files.lamp_pos,
        "lamp_color": files.lamp_color,
        "home": np.frombuffer(files.home, np.uint8),
    }
    for k, (bodies, data) in enumerate(files.movable):
        arrays[f"bodies{k}"] = np.array(bodies, np.int32)
        arrays[f"file{k}"] = np.frombuffer(data, np.uint8)
    return arrays


def _read(path: Path) -> HomeFiles | None:
    """Files from the cache; None if it does not exist or cannot be read, in which case they are computed again."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            count = sum(name.startswith("bodies") for name in arrays.files)
            movable = tuple(
                (tuple(arrays[f"bodies{k}"].tolist()), arrays[f"file{k}"].tobytes())
                for k in range(count)
            )
            home = arrays["home"].tobytes()
            return HomeFiles(home, movable, arrays["lamp_pos"], arrays["lamp_color"])
    except (KeyError, ValueError, OSError, EOFError, zipfile.BadZipFile):
        return None


def glb(model: Model, looks: tuple[Look, ...]) -> bytes:
    """Export one model as a GLB file; its parts index ``looks``."""
    scene = trimesh.Scene()
    for part in model.parts:
        # v runs down from the top of an image in glTF, and up from its bottom in trimesh.
        uv = part.uv * (1.0, -1.0) + (0.0, 1.0)
        mesh = trimesh.Trimesh(
            part.vertices,
            part.faces,
            vertex_normals=part.normals,
            visual=TextureVisuals(uv, material=_material(looks[part.look])),
            # trimesh would merge vertices, and with them the edges of textures.
            process=False,
        )
        scene.add_geometry(mesh)
    return export_glb(scene, include_normals=True)


def _material(look: Look) -> PBRMaterial:
    picture = None
    if look.texture is not None:
        picture = Image.fromarray(look.texture)
        # trimesh encodes an image in the format of this attribute.
        picture.format = JPEG
    return PBRMaterial(
        baseColorFactor=np.append(look.color, 1.0),
        baseColorTexture=picture,
        metallicFactor=0.0,
        roughnessFactor=1.0 - 0.6 * look.gloss,
        doubleSided=False,
    )
