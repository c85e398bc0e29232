"""Reader of binary glTF files: triangles in metres with all node transforms applied, and base colour textures.

It supports static triangle meshes with one base colour texture per primitive and ``KHR_texture_transform``, which is
what ReplicaCAD and YCB use. The axes are those of the file (+y up).

Our own and not ``trimesh.load_scene``, measured with trimesh 5.2 on the 210 files of ReplicaCAD and YCB (1,908
primitives), because homes, caches and models are hashes of what this reader returns:

- Faces are the same and vertices differ by up to 8e-7 m, but 1,113 primitives have other bits, 79 files another order
  of their parts, 5 of 12 base colours are rounded to 8 bits, and ``KHR_texture_transform`` (3 files) is ignored.
- Reading is as fast (1.7 s against 1.9 s without textures), but the import takes 2.1 s against 0.8 s.
- Of 23 broken files of ``tests/hostile/cases.py`` it reads 7 without an error, one of 1.6 gigapixels and nodes that
  contain themselves among them, and raises seven types of errors for the others; all must be a `UsageError` here.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.errors import fault
from mjhab.core.files.reading import parse_json, read_bytes, reason
from mjhab.core.rotations import mat_from_quat
from mjhab.scenes.formats.fields import Fields
from mjhab.scenes.pack_check import MAX_FILE_NUMBER

_COMPONENT = {
    5120: np.int8,
    5121: np.uint8,
    5122: np.int16,
    5123: np.uint16,
    5125: np.uint32,
    5126: np.float32,
}
_ANY = frozenset(_COMPONENT)
"""All component types."""
_WHOLE = _ANY - {5126}
"""Integer component types."""
_INDICES = frozenset({5121, 5123, 5125})
"""Component types of vertex indices."""
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}
_TRIANGLES = 4
MAX_NODE_DEPTH = 100
MAX_NODES = 10_000
MAX_FILE_MB = 1024
"""Largest size of a file [MB]."""
MAX_TEXTURE = 512
"""Longest side of a texture [px]."""
MAX_TEXTURE_PIXELS = 2**26
"""Largest number of pixels of a texture; the largest one of ReplicaCAD has 2**24."""
MAX_PIXELS = 2**28
"""Largest number of pixels of all textures of a file."""
MAX_UV = 1e6
"""Largest absolute texture coordinate, after its transform."""
_IMAGE_FORMATS = ("PNG", "JPEG")
"""Image formats that glTF allows."""
TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation from the axes of a file, +y up, to ours, +z up: (x, y, z) becomes (x, -z, y)."""


@dataclass(frozen=True, eq=False)
class Primitive:
    """Triangles of one material. V vertices, F faces.

    Attributes:
        mesh: name of the glTF mesh that it belongs to; its index if it has none.
        vertices: (V, 3) float64 [m] in the frame of the file.
        faces: (F, 3) int32.
        uv: (V, 2) float64 with (0, 0) at the corner of the first texel; None for none.
        texture: (h, w, 3) uint8 sRGB, sides powers of two up to `MAX_TEXTURE`; None for none.
        color: (3,) linear factor of the base colour.
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
        textures: also read texture coordinates and decode the base colour textures.

    Raises:
        UsageError: the file is missing, truncated or invalid; the message names the file and the part.
    """
    document, blob = _chunks(path)
    try:
        # Values that overflow are refused below.
        with np.errstate(over="ignore", invalid="ignore"):
            parts = _Reader(document, blob).primitives(textures)
    except ValueError as error:
        raise fault(path, f"broken glTF ({error}); download the file again.") from error
    for part in parts:
        if not (np.abs(part.vertices) <= MAX_FILE_NUMBER).all():
            raise fault(
                path,
                f"mesh {part.mesh!r} has vertices that are not finite or beyond {MAX_FILE_NUMBER:g}.",
            )
    return parts


def read_hulls(path: Path) -> list[np.ndarray]:
    """Read a convex decomposition with one glTF mesh per hull.

    Returns:
        Distinct points (P, 3) float64 [m] of every hull, in the frame of the file.

    Raises:
        UsageError: as `read_glb`, or a hull has fewer than four points.
    """
    hulls = []
    for part in read_glb(path, textures=False):
        used = part.vertices[np.unique(part.faces)]
        # Points are stored once per face corner, and differ by rounding errors.
        keys = np.unique(np.round(used, 6), axis=0, return_index=True)[1]
        # In the order of the file, which does not change with rounding.
        points = used[np.sort(keys)]
        if len(points) < 4:
            raise fault(
                path,
                f"mesh {part.mesh!r} has {len(points)} distinct points; a hull needs four.",
            )
        hulls.append(points)
    return hulls


def _chunks(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk of a file."""
    # A limit, since a file from elsewhere must not exhaust memory.
    raw = read_bytes(path, MAX_FILE_MB)
    if len(raw) < 20 or raw[:4] != b"glTF":
        raise fault(
            path, "not a binary glTF file (no 'glTF' header); download the file again."
        )
    length = struct.unpack_from("<I", raw, 8)[0]
    if length > len(raw):
        raise fault(
            path,
            f"cut off: the header says {length} bytes, the file has {len(raw)}; download it again.",
        )
    found: dict[bytes, bytes] = {}
    offset = 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<I4s", raw, offset)
        if offset + 8 + size > length:
            raise fault(path, f"chunk {kind!r} is cut off; download the file again.")
        # The first chunk of a kind counts, as the format has it; unknown kinds are ignored.
        found.setdefault(kind, raw[offset + 8 : offset + 8 + size])
        offset += 8 + size
    if b"JSON" not in found:
        raise fault(path, "no JSON chunk; download the file again.")
    try:
        document = parse_json(found[b"JSON"])
    except ValueError as error:
        raise fault(
            path, f"the JSON chunk is broken ({error}); download the file again."
        ) from error
    if not isinstance(document, dict):
        raise fault(path, "the JSON chunk is no object; download the file again.")
    return document, found.get(b"BIN\0", b"")


class _Reader:
    """Read the triangles of a document.

    Raises:
        ValueError: the document is invalid; raised by all methods.
    """

    def __init__(self, document: dict[str, Any], blob: bytes) -> None:
        self.document = Fields(document, "")
        self.blob = blob
        self._images: dict[int, np.ndarray] = {}
        self._visits = 0
        self._pixels = 0

    def primitives(self, textures: bool) -> list[Primitive]:
        nodes = self.document.parts("nodes")
        children = {child for node in nodes for child in node.wholes("children")}
        roots: list[int] = []
        if self.document.parts("scenes"):
            roots = self.document.pick("scenes", self.document.whole("scene", 0)).wholes(
                "nodes"
            )
        out: list[Primitive] = []
        # Files may lack a scene: then every node that is no child is a root.
        for root in roots or [i for i in range(len(nodes)) if i not in children]:
            self._walk(root, np.eye(4), textures, out, 0)
        if not out:
            raise ValueError("no triangles")
        return out

    def _walk(
        self,
        index: int,
        parent: np.ndarray,
        textures: bool,
        out: list[Primitive],
        depth: int,
    ) -> None:
        self._visits += 1
        # Nodes may name each other in a circle.
        if depth > MAX_NODE_DEPTH or self._visits > MAX_NODES:
            raise ValueError("nodes that contain each other, or far too many of them")
        node = self.document.pick("nodes", index)
        pose = parent @ _local(node)
        if "mesh" in node:
            number = node.whole("mesh")
            mesh = self.document.pick("meshes", number)
            name = mesh.text("name") if "name" in mesh else str(number)
            for part in mesh.parts("primitives"):
                if part.whole("mode", _TRIANGLES) == _TRIANGLES:
                    made = self._primitive(name, part, pose, textures)
                    # Empty meshes occur, and nothing could be drawn of them.
                    if len(made.faces):
                        out.append(made)
        for child in node.wholes("children"):
            self._walk(child, pose, textures, out, depth + 1)

    def _primitive(
        self, name: str, part: Fields, pose: np.ndarray, textures: bool
    ) -> Primitive:
        attributes = part.part("attributes")
        points = self._array(attributes.whole("POSITION"), "VEC3", _ANY)
        vertices = points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        # Without indices the vertices are corners in order.
        corners = np.arange(len(vertices))
        if "indices" in part:
            corners = self._array(part.whole("indices"), "SCALAR", _INDICES).ravel()
        if len(corners) % 3:
            raise ValueError(
                f"{part.where} has {len(corners)} corners, which are no triangles"
            )
        if len(corners) and int(corners.max()) >= len(vertices):
            raise ValueError(f"mesh {name!r} names a vertex that does not exist")
        faces = corners.reshape(-1, 3).astype(np.int32)
        # A mirroring transform turns faces inside out.
        if np.linalg.det(pose[:3, :3]) < 0:
            faces = faces[:, ::-1].copy()
        if not textures:
            return Primitive(name, vertices, faces, None, None, np.ones(3))
        color, texture, bend = self._look(part)
        if "TEXCOORD_0" not in attributes:
            return Primitive(name, vertices, faces, None, None, color)
        uv = self._array(attributes.whole("TEXCOORD_0"), "VEC2", _ANY).astype(np.float64)
        if len(uv) != len(vertices):
            raise ValueError(
                f"mesh {name!r} has {len(vertices)} vertices and {len(uv)} TEXCOORD_0"
            )
        uv = np.c_[uv, np.ones(len(uv))] @ bend.T
        if not (np.abs(uv) <= MAX_UV).all():
            raise ValueError(
                f"mesh {name!r} has TEXCOORD_0 beyond {MAX_UV:g} or not finite"
            )
        return Primitive(name, vertices, faces, uv, texture, color)

    def _array(self, index: int, shape: str, kinds: Collection[int]) -> np.ndarray:
        """Data (count, components) of an accessor.

        Args:
            index: index of the accessor.
            shape: its required type, such as "VEC3".
            kinds: component types that it may have.
        """
        accessor = self.document.pick("accessors", index)
        view = self.document.pick("bufferViews", accessor.whole("bufferView"))
        component = accessor.whole("componentType")
        if component not in kinds or accessor.text("type") != shape:
            raise ValueError(f"{accessor.where} is no {shape} of a fitting componentType")
        kind = _COMPONENT[component]
        width = _WIDTH[shape]
        count = accessor.whole("count")
        size = np.dtype(kind).itemsize
        start = view.whole("byteOffset", 0) + accessor.whole("byteOffset", 0)
        stride = view.whole("byteStride", size * width)
        if stride < size * width:
            raise ValueError(
                f"{view.place('byteStride')}: {stride} bytes are less than an element"
            )
        # numpy would read beyond the buffer without a complaint.
        if count and start + stride * (count - 1) + size * width > len(self.blob):
            raise ValueError(f"{accessor.where} reaches past the end of the binary chunk")
        if not count:
            return np.zeros((0, width), kind)
        data = np.ndarray((count, width), kind, self.blob, start, (stride, size))
        if (
            "normalized" in accessor
            and accessor.value("normalized")
            and component in _WHOLE
        ):
            # The format stores fractions as integers up to the largest one.
            data = data / np.iinfo(kind).max
        return data

    def _look(self, part: Fields) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Base colour factor (3,), texture, and affine map (2, 3) of the texture coordinates of a primitive."""
        bend = np.eye(2, 3)
        if "material" not in part:
            return np.ones(3), None, bend
        material = self.document.pick("materials", part.whole("material"))
        surface = material.part("pbrMetallicRoughness")
        color = surface.numbers("baseColorFactor", (1.0, 1.0, 1.0, 1.0))[:3]
        if not ((color >= 0.0) & (color <= 1.0)).all():
            raise ValueError(
                f"{surface.place('baseColorFactor')}: expected numbers from 0 to 1"
            )
        if "baseColorTexture" not in surface:
            return color, None, bend
        reference = surface.part("baseColorTexture")
        extensions = reference.part("extensions")
        if "KHR_texture_transform" in extensions:
            moved = extensions.part("KHR_texture_transform")
            sx, sy = moved.numbers("scale", (1.0, 1.0))
            ox, oy = moved.numbers("offset", (0.0, 0.0))
            angle = moved.number("rotation", 0.0)
            c = np.cos(angle)
            s = np.sin(angle)
            bend = np.array([[c * sx, s * sy, ox], [-s * sx, c * sy, oy]])
        texture = self.document.pick("textures", reference.whole("index"))
        return color, self._image(texture.whole("source")), bend

    def _image(self, index: int) -> np.ndarray:
        if index not in self._images:
            self._images[index] = self._decoded(index)
        return self._images[index]

    def _decoded(self, index: int) -> np.ndarray:
        # On use: packs without textures are opened without Pillow.
        from PIL import Image

        image = self.document.pick("images", index)
        view = self.document.pick("bufferViews", image.whole("bufferView"))
        start = view.whole("byteOffset", 0)
        data = io.BytesIO(self.blob[start : start + view.whole("byteLength")])
        try:
            # Only the formats of glTF: Pillow's other decoders are a needless risk with files from elsewhere.
            with Image.open(data, formats=_IMAGE_FORMATS) as picture:
                # The size is known before decoding; a small file may decompress to very many pixels.
                width, height = picture.size
                self._pixels += width * height
                if width * height > MAX_TEXTURE_PIXELS or self._pixels > MAX_PIXELS:
                    raise ValueError(
                        f"{image.where} has {width} x {height} pixels, too many"
                    )
                rgb = picture.convert("RGB")
        except (SyntaxError, OSError, Image.DecompressionBombError) as error:
            raise ValueError(f"{image.where}: {reason(error)}") from error
        # Sides that are powers of two have exact mip levels.
        width, height = (
            min(MAX_TEXTURE, 1 << (side.bit_length() - 1)) for side in rgb.size
        )
        return np.asarray(rgb.resize((width, height), Image.Resampling.BOX))


def _local(node: Fields) -> np.ndarray:
    """Transform (4, 4) from a node to its parent."""
    if "matrix" in node:
        # glTF stores matrices column by column.
        return node.numbers("matrix", tuple(np.eye(4).ravel())).reshape(4, 4).T
    pose = np.eye(4)
    x, y, z, w = node.numbers("rotation", (0.0, 0.0, 0.0, 1.0))
    turn = mat_from_quat(np.array([w, x, y, z], float))
    pose[:3, :3] = turn * node.numbers("scale", (1.0, 1.0, 1.0))
    pose[:3, 3] = node.numbers("translation", (0.0, 0.0, 0.0))
    return pose
