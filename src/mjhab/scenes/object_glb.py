"""Object types from binary glTF files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from scipy.spatial import QhullError

from mjhab.core.errors import fault, shown
from mjhab.core.names import check_name
from mjhab.core.typed.options import fitting
from mjhab.scenes.formats.gltf import TO_Z_UP, Primitive, read_glb
from mjhab.scenes.objects import ObjectModel
from mjhab.scenes.pack_check import MAX_MASS_KG, MIN_MASS_KG, check_range
from mjhab.scenes.shapes.hulls import hull_mesh
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.shapes.painting import textured_mesh
from mjhab.scenes.shapes.shapes import look
from mjhab.scenes.spec import Geom, ObjectType

COLLISION_PREFIX = "collision"
"""Prefix of the names of collision meshes in a file, which are not rendered."""
MAX_PIECES = 64
"""Largest number of collision pieces of an object; each adds to the time of collision detection."""
MIN_EXTENT_M = 0.002
"""Smallest extent of an object along an axis [m]; smaller files are probably in another unit."""
MAX_EXTENT_M = 0.6
"""Largest extent of an object along an axis [m]; larger files are probably in another unit."""


def object_from_glb(
    name: str,
    path: Path | str,
    mass: float,
    scale: float = 1.0,
    words: tuple[str, ...] = (),
) -> ObjectModel:
    """Make an object type from a ``.glb`` file (glTF 2.0: +y up, metres).

    Every mesh whose name begins with ``collision`` is a collision piece: its convex hull collides, and it is not
    rendered. The other meshes are rendered with their colours and textures. Without collision meshes the hull of every
    rendered mesh collides. The file's orientation is that of the standing object; the origin becomes the centre of the
    bounding box of its pieces. Grasps are sampled on the surface of the pieces (`mjhab.episodes.grasps.antipodal`).

    Args:
        name: name of the object type.
        path: the file.
        mass: [kg], with uniform density over the volume of the pieces.
        scale: factor from the unit of the file to metres.
        words: its names in instructions, see `ObjectModel`.

    Raises:
        UsageError: the file is missing or broken, a collision mesh is flat, there are more than `MAX_PIECES`, or name,
            mass or size is out of bounds.

    Example:
        >>> mug = mjhab.object_from_glb("mug", "examples/mug/mug.glb", mass=0.25)
        >>> mjhab.register_object(mug)
    """
    path = Path(fitting("path of the object", str, path))
    mass = fitting(f"mass of {shown(name)}", float, mass)
    scale = fitting(f"scale of {shown(name)}", float, scale)
    check_name("name of the object", name)
    check_range(f"mass of {name}", mass, MIN_MASS_KG, MAX_MASS_KG, "kg")
    check_range(f"scale of {name}", scale, 1e-6, 1e6, "1")
    # Scaled at once, so that all limits are in metres.
    parts = [_upright(part, scale) for part in read_glb(path)]
    pieces = [part for part in parts if part.mesh.startswith(COLLISION_PREFIX)]
    seen = [part for part in parts if not part.mesh.startswith(COLLISION_PREFIX)]
    hulls = [_hull(path, part) for part in pieces or seen]
    if len(hulls) > MAX_PIECES:
        raise fault(
            path, f"{len(hulls)} collision pieces; an object has at most {MAX_PIECES}."
        )
    points = np.concatenate([hull.vertices for hull in hulls]).astype(float)
    # Rounded, so that the last bits of hulls do not change the type and all that is cached for it.
    center = ((points.min(axis=0) + points.max(axis=0)) / 2).round(6)
    half = (np.ptp(points, axis=0) / 2).round(6)
    check_extent(
        path, 2 * half, "Files are read in metres; `scale` converts from another unit."
    )
    meshes = {f"{name}/piece_{k}": _moved(hull, -center) for k, hull in enumerate(hulls)}
    collision = tuple(
        Geom("mesh", (1.0, 1.0, 1.0), mesh=mesh, visual=False) for mesh in meshes
    )
    drawn = [
        dataclasses.replace(part, vertices=part.vertices - center)
        for part in seen or pieces
    ]
    x, y, z = half.tolist()
    kind = ObjectType(
        name,
        float(mass),
        (x, y, z),
        collision,
        (look(f"{name}/look", "plain_white"),),
        grasp_shape="mesh",
    )
    return ObjectModel(kind, {**meshes, f"{name}/look": textured_mesh(drawn)}, words)


def _upright(part: Primitive, scale: float) -> Primitive:
    return dataclasses.replace(part, vertices=scale * part.vertices @ TO_Z_UP.T)


def _hull(path: Path, part: Primitive) -> Mesh:
    try:
        # Only vertices of faces: files keep stray ones, which would enlarge the hull.
        return hull_mesh(np.unique(part.vertices[np.unique(part.faces)].round(7), axis=0))
    except (QhullError, ValueError) as error:
        raise fault(
            path,
            f"mesh {part.mesh!r} is flat or has fewer than four points, so that it has no convex hull.",
        ) from error


def _moved(mesh: Mesh, shift: np.ndarray) -> Mesh:
    return dataclasses.replace(mesh, vertices=(mesh.vertices + shift).astype(np.float32))


def check_extent(path: Path, extent: np.ndarray, remedy: str) -> None:
    """Check the size of an object.

    Args:
        path: the file, for the message.
        extent: (3,) of its bounding box [m].
        remedy: what to do with another size, a sentence for the message.

    Raises:
        UsageError: an extent is not within `MIN_EXTENT_M` and `MAX_EXTENT_M`.
    """
    measured = " x ".join(f"{size:g}" for size in extent.tolist())
    if extent.max() > MAX_EXTENT_M or extent.min() < MIN_EXTENT_M:
        raise fault(
            path,
            f"the object measures {measured} m; expected {MIN_EXTENT_M:g} to {MAX_EXTENT_M:g} m along every "
            f"axis. {remedy}",
        )
