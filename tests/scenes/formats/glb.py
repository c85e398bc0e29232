"""Small glTF files and a tiny data set in ReplicaCAD's format, for tests of the readers."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

BOX = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
BOX_FACES = np.array(
    [t for a, b, c, d in ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
     for t in ((a, b, c), (a, c, d))], np.uint16,
)  # fmt: skip
"""Triangles of `BOX`, counter-clockwise from outside."""


def write_glb(
    path: Path,
    parts: list[tuple[np.ndarray, np.ndarray]],
    nodes: list[dict[str, Any]] | None = None,
    uv: np.ndarray | None = None,
    image: np.ndarray | None = None,
    transform: dict[str, Any] | None = None,
    double_sided: bool = False,
) -> Path:
    """Write meshes (vertices, faces) as a file; by default one node for each. ``image`` (H, W, 3) is their texture."""
    blob = b""
    views = []
    accessors = []
    meshes = []

    def add(data: np.ndarray, kind: str, component: int) -> int:
        nonlocal blob
        raw = data.tobytes()
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(raw)})
        blob += raw + b"\0" * (-len(raw) % 4)
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[kind]
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": component,
                "count": data.size // width,
                "type": kind,
            }
        )
        return len(accessors) - 1

    for k, (vertices, faces) in enumerate(parts):
        attributes = {"POSITION": add(np.asarray(vertices, np.float32), "VEC3", 5126)}
        if uv is not None:
            attributes["TEXCOORD_0"] = add(np.asarray(uv, np.float32), "VEC2", 5126)
        primitive: dict[str, Any] = {
            "attributes": attributes,
            "indices": add(np.asarray(faces, np.uint16).ravel(), "SCALAR", 5123),
        }
        if image is not None or double_sided:
            primitive["material"] = 0
        meshes.append({"name": f"part_{k}", "primitives": [primitive]})
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "meshes": meshes,
        "nodes": nodes
        if nodes is not None
        else [{"mesh": k} for k in range(len(meshes))],
    }
    children = {c for node in document["nodes"] for c in node.get("children", [])}
    document["scenes"] = [
        {"nodes": [k for k in range(len(document["nodes"])) if k not in children]}
    ]
    if image is not None:
        stream = io.BytesIO()
        Image.fromarray(np.asarray(image, np.uint8)).save(stream, "PNG")
        add_view = stream.getvalue()
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(add_view)})
        blob += add_view + b"\0" * (-len(add_view) % 4)
        texture: dict[str, Any] = {"index": 0}
        if transform:
            texture["extensions"] = {"KHR_texture_transform": transform}
        document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": texture}}]
        document["textures"] = [{"source": 0}]
        document["images"] = [{"bufferView": len(views) - 1, "mimeType": "image/png"}]
    if double_sided:
        document.setdefault("materials", [{}])[0]["doubleSided"] = True
    document |= {
        "bufferViews": views,
        "accessors": accessors,
        "buffers": [{"byteLength": len(blob)}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = (
        struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(blob), b"BIN\0")
        + blob
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    return path


def box_glb(
    path: Path,
    *halves: tuple[float, float, float],
    at: tuple[tuple[float, float, float], ...] = (),
) -> Path:
    """Write boxes of half-extents [m] (data set axes), each at a place (the origin by default)."""
    places = at or ((0.0, 0.0, 0.0),) * len(halves)
    return write_glb(
        path,
        [
            (BOX * np.array(h) + np.array(p), BOX_FACES)
            for h, p in zip(halves, places, strict=True)
        ],
    )


URDF = """<robot name="chest"><link name="root"/><joint name="up" type="fixed"><origin rpy="1.565 0 0"/>
<parent link="root"/><child link="body"/></joint>
<link name="body"><inertial><mass value="9"/></inertial>
<visual><geometry><mesh filename="chest.glb" scale="1, 1, 1"/></geometry></visual>
<collision><origin xyz="0 0.5, 0"/><geometry><box size="0.4 1.0, 0.6"/></geometry></collision></link></robot>"""


def tiny_data_set(folder: Path) -> Path:
    """A data set of one staged scene: a table, a mat and a chest laid on its side by the scene; no stage mesh."""
    box_glb(folder / "objects" / "frl_apartment_table.glb", (0.5, 0.4, 0.3))
    box_glb(
        folder / "objects" / "convex" / "frl_apartment_table_cv_decomp.glb",
        (0.5, 0.02, 0.3),
        (0.05, 0.19, 0.05),
        at=((0, 0.38, 0), (0, 0.17, 0)),
    )
    box_glb(folder / "objects" / "frl_apartment_mat.glb", (0.4, 0.01, 0.3))
    box_glb(folder / "urdf" / "chest" / "chest.glb", (0.2, 0.5, 0.3))
    (folder / "urdf" / "chest" / "chest.urdf").write_text(URDF)
    write(
        folder / "configs" / "objects" / "frl_apartment_table.object_config.json",
        {
            "render_asset": "../../objects/frl_apartment_table.glb",
            "mass": 5,
            "collision_asset": "../../objects/convex/frl_apartment_table_cv_decomp.glb",
            "user_defined": {
                "receptacle_aabb_Top_frl_apartment_table": {
                    "parent_object": "frl_apartment_table",
                    "position": [0, 0.5, 0],
                    "scale": [-0.6, 0.11, -0.2],
                }
            },
        },
    )
    write(
        folder / "configs" / "objects" / "frl_apartment_mat.object_config.json",
        {
            "render_asset": "../../objects/frl_apartment_mat.glb",
            "use_bounding_box_for_collision": True,
            "mass": 1,
        },
    )
    write(
        folder / "configs" / "stages" / "Stage.stage_config.json",
        {"render_asset": "../../stages/Stage.glb"},
    )
    write(folder / "configs" / "scenes" / "v3_sc3_staging_07.scene_instance.json", {
        "stage_instance": {"template_name": "stages/Stage"},
        "object_instances": [
            {"template_name": "objects/frl_apartment_table", "translation": [1, 0.4, 2], "rotation": [0.6, 0, 0.8, 0]},
            {"template_name": "frl_apartment_mat", "translation": [-1, 0.01, 0], "rotation": [1, 0, 0, 0]}],
        "articulated_object_instances": [
            {"template_name": "chest", "translation": [0, 0, -2], "rotation": [-0.707, 0.707, 0, 0],
             "uniform_scale": 0.5},
            {"template_name": "door2", "translation": [0, 0, 0]}],
    })  # fmt: skip
    return folder


def write(path: Path, body: Any) -> None:
    """Write JSON, making the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(body))
