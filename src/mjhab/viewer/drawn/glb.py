"""Models as GLB files, which browsers read: geometry, materials and textures in one piece of bytes."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

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
from mjhab.viewer.drawn.models import HomeModels, Look, Model

JPEG = "JPEG"


@dataclass(frozen=True, eq=False)
class HomeFiles:
    """The models of one home as GLB files; ``movable``: the bodies of each, and the file.

    lamp_pos (L, 3) [m], lamp_color (L, 3) linear rgb times intensity.
    """

    home: bytes
    movable: tuple[tuple[tuple[int, ...], bytes], ...]
    lamp_pos: np.ndarray
    lamp_color: np.ndarray


def home_files(layout: Layout, home: str, make: Callable[[], HomeModels]) -> HomeFiles:
    """The files of a home of a layout; kept on disk.

    Args:
        layout: names the home.
        home: its name.
        make: makes its models, where there are no files of them.
    """
    path = cache_dir() / "viewer" / f"{_digest(layout, home)}.npz"
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
        write_cached(path, lambda temporary: np.savez(temporary, allow_pickle=False, **arrays))
    return found


def _digest(layout: Layout, home: str) -> str:
    spec = next(h for h in layout.pack.homes if h.name == home)
    digest = hashlib.sha256(home_hash(layout, spec).encode())
    digest.update(code_digest("viewer.drawn.glb", "viewer.drawn.models", "render", "robots"))
    # Furniture that only looks different does not change the physics, whose hash that of the home is.
    for name, mesh in sorted(layout.pack.meshes.items()):
        digest.update(name.encode() + mesh.vertices.tobytes())  # type: ignore[attr-defined]
    return digest.hexdigest()[:24]


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
    """None if there is no such file, or it cannot be read: it is then made anew."""
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
    """One model as a GLB file; its materials are among ``looks``."""
    scene = trimesh.Scene()
    for part in model.parts:
        # glTF counts v from the top of a picture, trimesh from its bottom.
        uv = part.uv * (1.0, -1.0) + (0.0, 1.0)
        mesh = trimesh.Trimesh(
            part.vertices,
            part.faces,
            vertex_normals=part.normals,
            visual=TextureVisuals(uv, material=_material(looks[part.look])),
            process=False,
        )
        scene.add_geometry(mesh)
    return export_glb(scene, include_normals=True)


def _material(look: Look) -> PBRMaterial:
    picture = None
    if look.texture is not None:
        picture = Image.fromarray(look.texture)
        # trimesh keeps the format that a picture says it came in.
        picture.format = JPEG
    return PBRMaterial(
        baseColorFactor=np.append(look.color, 1.0),
        baseColorTexture=picture,
        metallicFactor=0.0,
        roughnessFactor=1.0 - 0.6 * look.gloss,
        doubleSided=False,
    )
