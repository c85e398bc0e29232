"""Binary glTF files: triangles in metres with every node transform applied, and the colours of their textures.

Read are static triangle meshes with one base colour texture per primitive, which is all that ReplicaCAD and YCB use
(with ``KHR_texture_transform``). The axes stay those of the file (+y up).
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.core.files.reading import parse_json
from mjhab.core.rotations import mat_from_quat
from mjhab.scenes.pack_check import MAX_FILE_NUMBER
from mjhab.scenes.shapes.meshes import MAX_TEXTURE

_COMPONENT = {
    5120: np.int8,
    5121: np.uint8,
    5122: np.int16,
    5123: np.uint16,
    5125: np.uint32,
    5126: np.float32,
}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TRIANGLES = 4
MAX_NODE_DEPTH = 100
MAX_NODES = 10_000
MAX_TEXTURE_PIXELS = 2**26
"""Limits of a file; the largest texture of ReplicaCAD has 2**24 pixels."""
TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns a vector of a file, with +y up, into our axes: (x, y, z) becomes (x, -z, y)."""


@dataclass(frozen=True, eq=False)
class Primitive:
    """Triangles of one material. V vertices, F faces.

    ``vertices`` (V, 3) float64 [m] in the frame of the file, ``faces`` (F, 3) int32, ``uv`` (V, 2) float64 with (0, 0)
    at the first pixel, or None; ``texture`` (H, W, 3) uint8 sRGB, sides powers of two, or None; ``color`` (3,) linear
    factor of the base colour; ``mesh`` the name of the glTF mesh it belongs to.
    """

    mesh: str
    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None
    texture: np.ndarray | None
    color: np.ndarray


def read_glb(path: Path, *, textures: bool = True) -> list[Primitive]:
    """Read a ``.glb`` file.

    Args:
        path: the file.
        textures: also decode the base colour textures.

    Raises:
        UsageError: the file is missing, cut off, or not what it says; names the file and the part.
    """
    document, blob = _chunks(path)
    reader = _Reader(path, document, blob)
    try:
        parts = reader.primitives(textures)
    except (
        KeyError,
        IndexError,
        TypeError,
        ValueError,
        struct.error,
        OSError,
        OverflowError,
    ) as error:
        raise UsageError(
            f"{path}: broken glTF ({type(error).__name__}: {error}); download the file again."
        ) from error
    for part in parts:
        if not (np.abs(part.vertices) <= MAX_FILE_NUMBER).all():
            raise UsageError(
                f"{path}: mesh {part.mesh!r} has vertices that are not finite or beyond {MAX_FILE_NUMBER:g}."
            )
    return parts


def read_hulls(path: Path) -> list[np.ndarray]:
    """Read a convex decomposition: the distinct points (P, 3) float64 [m] of every hull, one glTF mesh each.

    Raises:
        UsageError: as ``read_glb``, or a hull has fewer than four points.
    """
    hulls = []
    for part in read_glb(path, textures=False):
        used = part.vertices[np.unique(part.faces)]
        # Points are stored once per face corner: equal to the last bit, or a rounding apart.
        keys = np.unique(np.round(used, 6), axis=0, return_index=True)[1]
        points = used[np.sort(keys)]
        if len(points) < 4:
            raise UsageError(
                f"{path}: mesh {part.mesh!r} has {len(points)} distinct points; a hull needs four."
            )
        hulls.append(points)
    return hulls


def _chunks(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk of a file."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror or error}).") from error
    if len(raw) < 20 or raw[:4] != b"glTF":
        raise UsageError(
            f"{path}: not a binary glTF file (no 'glTF' header); download the file again."
        )
    length = struct.unpack_from("<I", raw, 8)[0]
    if length > len(raw):
        raise UsageError(
            f"{path}: cut off: the header says {length} bytes, the file has {len(raw)}; download it again."
        )
    found: dict[bytes, bytes] = {}
    offset = 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<I4s", raw, offset)
        if offset + 8 + size > length:
            raise UsageError(f"{path}: chunk {kind!r} is cut off; download the file again.")
        found.setdefault(kind, raw[offset + 8 : offset + 8 + size])
        offset += 8 + size
    if b"JSON" not in found:
        raise UsageError(f"{path}: no JSON chunk; download the file again.")
    try:
        document = parse_json(found[b"JSON"])
    except ValueError as error:
        raise UsageError(
            f"{path}: the JSON chunk is broken ({error}); download the file again."
        ) from error
    if not isinstance(document, dict):
        raise UsageError(f"{path}: the JSON chunk is no object; download the file again.")
    return document, found.get(b"BIN\0", b"")


class _Reader:
    def __init__(self, path: Path, document: dict[str, Any], blob: bytes) -> None:
        self.path = path
        self.document = document
        self.blob = blob
        self._images: dict[int, np.ndarray] = {}
        self._visits = 0

    def primitives(self, textures: bool) -> list[Primitive]:
        scenes = self.document.get("scenes", [])
        nodes = self.document["nodes"]
        children = {child for node in nodes for child in node.get("children", [])}
        roots = scenes[self.document.get("scene", 0)]["nodes"] if scenes else []
        out: list[Primitive] = []
        for root in roots or [i for i in range(len(nodes)) if i not in children]:
            self._walk(root, np.eye(4), textures, out, 0)
        if not out:
            raise UsageError(f"{self.path}: no triangles; download the file again.")
        return out

    def _walk(
        self, index: int, parent: np.ndarray, textures: bool, out: list[Primitive], depth: int
    ) -> None:
        self._visits += 1
        if depth > MAX_NODE_DEPTH or self._visits > MAX_NODES:
            raise ValueError("nodes that contain each other, or far too many of them")
        node = self.document["nodes"][index]
        pose = parent @ _local(node)
        if "mesh" in node:
            mesh = self.document["meshes"][node["mesh"]]
            for part in mesh["primitives"]:
                if part.get("mode", _TRIANGLES) == _TRIANGLES:
                    out.append(
                        self._primitive(str(mesh.get("name", node["mesh"])), part, pose, textures)
                    )
        for child in node.get("children", []):
            self._walk(child, pose, textures, out, depth + 1)

    def _primitive(
        self, name: str, part: dict[str, Any], pose: np.ndarray, textures: bool
    ) -> Primitive:
        attributes = part["attributes"]
        vertices = (
            self._array(attributes["POSITION"]).astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        )
        if "indices" in part:
            faces = self._array(part["indices"]).reshape(-1, 3).astype(np.int32)
        else:
            faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
        if faces.size and int(faces.max()) >= len(vertices):
            raise ValueError(f"mesh {name!r} names a vertex that does not exist")
        if np.linalg.det(pose[:3, :3]) < 0:
            faces = faces[:, ::-1].copy()
        if not textures:
            return Primitive(name, vertices, faces, None, None, np.ones(3))
        color, texture, bend = self._look(part)
        uv = (
            self._array(attributes["TEXCOORD_0"]).astype(np.float64)
            if "TEXCOORD_0" in attributes
            else None
        )
        if uv is not None:
            uv = np.c_[uv, np.ones(len(uv))] @ bend.T
        return Primitive(name, vertices, faces, uv, texture if uv is not None else None, color)

    def _array(self, index: int) -> np.ndarray:
        accessor = self.document["accessors"][index]
        view = self.document["bufferViews"][accessor["bufferView"]]
        kind = _COMPONENT[accessor["componentType"]]
        width = _WIDTH[accessor["type"]]
        count = accessor["count"]
        size = np.dtype(kind).itemsize
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", size * width)
        if min(count, start) < 0 or stride < size * width:
            raise ValueError(f"accessor {index} has a count, a place or a stride that cannot be")
        if count and start + stride * (count - 1) + size * width > len(self.blob):
            raise ValueError(f"accessor {index} reaches past the end of the binary chunk")
        data = np.ndarray((count, width), kind, self.blob, start, (stride, size))
        if accessor.get("normalized"):
            data = data / np.iinfo(kind).max
        return data

    def _look(self, part: dict[str, Any]) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Colour factor (3,), texture, and the (2, 3) map of texture coordinates of a primitive."""
        bend = np.eye(2, 3)
        if "material" not in part:
            return np.ones(3), None, bend
        surface = self.document["materials"][part["material"]].get("pbrMetallicRoughness", {})
        color = np.asarray(surface.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))[:3], float)
        if "baseColorTexture" not in surface:
            return color, None, bend
        reference = surface["baseColorTexture"]
        moved = reference.get("extensions", {}).get("KHR_texture_transform")
        if moved:
            (sx, sy) = moved.get("scale", (1, 1))
            (ox, oy) = moved.get("offset", (0, 0))
            c = np.cos(moved.get("rotation", 0.0))
            s = np.sin(moved.get("rotation", 0.0))
            bend = np.array([[c * sx, s * sy, ox], [-s * sx, c * sy, oy]])
        return color, self._image(self.document["textures"][reference["index"]]["source"]), bend

    def _image(self, index: int) -> np.ndarray:
        if index not in self._images:
            from PIL import Image

            view = self.document["bufferViews"][self.document["images"][index]["bufferView"]]
            start = view.get("byteOffset", 0)
            data = io.BytesIO(self.blob[start : start + view["byteLength"]])
            try:
                with Image.open(data) as image:
                    if image.width * image.height > MAX_TEXTURE_PIXELS:
                        raise ValueError(f"image {index} has {image.width} x {image.height} pixels")
                    rgb = image.convert("RGB")
            except (SyntaxError, Image.DecompressionBombError) as error:
                raise ValueError(f"image {index}: {error}") from error
            # Powers of two repeat and halve exactly.
            width, height = (min(MAX_TEXTURE, 1 << (side.bit_length() - 1)) for side in rgb.size)
            self._images[index] = np.asarray(rgb.resize((width, height), Image.Resampling.BOX))
        return self._images[index]


def _local(node: dict[str, Any]) -> np.ndarray:
    """The (4, 4) transform of a node in its parent."""
    if "matrix" in node:
        return np.asarray(node["matrix"], float).reshape(4, 4).T
    pose = np.eye(4)
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    pose[:3, :3] = mat_from_quat(np.array([w, x, y, z], float)) * np.asarray(
        node.get("scale", (1, 1, 1)), float
    )
    pose[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return pose
