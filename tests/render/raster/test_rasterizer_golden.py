"""Pictures of today against pictures that somebody looked at: ``tests/sim/golden/*.png``.

The scene is made here, so only the rasterizer, its lights, patterns and textures can change it. After a wanted change
of looks run

    MJHAB_UPDATE_GOLDEN=1 pytest tests/render/raster/test_rasterizer_golden.py

LOOK at the new pictures, and commit them. Depth is stored in steps of 0.2 mm. Tolerances allow for other processors
(the colours are compiled with fast arithmetic): a few pixels at edges, and one or two steps of colour.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from PIL import Image

from mjhab.render.build_scene import SceneBuilder
from mjhab.render.cameras import Cameras, look_at
from mjhab.render.raster.rasterizer import Rasterizer
from mjhab.scenes.builtin.objects import builtin_objects, object_meshes
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.shapes.shapes import about_z
from mjhab.scenes.spec import Geom, Light

FOLDER = Path(__file__).parent / "golden"
SIZE = 96
DEPTH_STEP = 0.0002
View = tuple[
    tuple[float, float, float], tuple[float, float, float], float, Literal["fast", "nice"]
]
VIEWS: dict[str, View] = {
    "room": ((-1.9, -1.6, 1.7), (0.4, 0.4, 0.5), 1.3, "fast"),
    "table": ((-0.55, -0.55, 1.35), (0.2, 0.1, 0.75), 1.0, "fast"),
    "hand": ((0.15, -0.1, 1.05), (0.15, 0.2, 0.75), 2.0, "fast"),
    "people": ((1.8, -1.4, 1.9), (0.0, 0.3, 0.4), 1.1, "nice"),
}
"""Eye, target [m], vertical field of view [rad], quality."""


def poster() -> Mesh:
    """A picture on a sheet of 0.8 m x 0.8 m: rings of colour and a white frame."""
    y, x = np.mgrid[-1:1:64j, -1:1:64j]
    image = np.stack(
        [128 + 120 * np.sin(9 * np.hypot(x, y)), 90 + 80 * x, 128 - 100 * y], -1
    ).clip(0, 255)
    image[np.maximum(np.abs(x), np.abs(y)) > 0.9] = 240
    corners = np.array(
        [[-0.4, 0, -0.4], [0.4, 0, -0.4], [0.4, 0, 0.4], [-0.4, 0, 0.4]], np.float32
    )
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)[faces]
    return Mesh(
        corners, faces, None, uv, np.zeros(2, np.int32), (image.astype(np.uint8),)
    )


def room() -> SceneBuilder:
    """A corner of a room: every pattern, a table with all objects, a ball that has levels of detail, a poster."""
    builder = SceneBuilder(1)
    meshes = object_meshes()
    for geom, name in (
        (Geom("box", (2.5, 2.5, 0.05), (0, 0, -0.05), material="floor_oak"), "floor"),
        (Geom("box", (2.5, 0.05, 1.3), (0, 2.0, 1.3), material="wall_sage"), "wall"),
        (Geom("box", (0.05, 2.5, 1.3), (2.0, 0, 1.3), material="backsplash"), "wall"),
        (Geom("box", (0.9, 0.6, 0.005), (-0.6, 0.9, 0.005), material="rug_red"), "rug"),
        (Geom("box", (0.5, 0.4, 0.02), (0.2, 0.1, 0.7), material="walnut"), "table"),
        (Geom("sphere", (0.25, 0, 0), (-0.9, 0.9, 0.25), material="sofa_fabric"), "ball"),
        (Geom("capsule", (0.06, 0.5, 0), (1.4, 1.5, 0.6), material="brass"), "post"),
    ):
        builder.add_world_geom(geom, seg=name)
    for x in (-0.25, 0.65):
        for y in (-0.25, 0.45):
            builder.add_world_geom(
                Geom("cylinder", (0.03, 0.34, 0), (x, y, 0.34), material="steel"),
                seg="table",
            )
    for k, (name, kind) in enumerate(builtin_objects().items()):
        at = np.array(
            [[-0.15 + 0.18 * (k % 5), -0.1 + 0.35 * (k // 5), 0.72 + kind.half[2]]]
        )
        for geom in kind.visuals:
            builder.add_world_geom(
                geom, at, np.array([about_z(0.5 * k)]), name, meshes=meshes
            )
    builder.add_world_instance(
        builder.add_mesh("poster", poster()), (0.3, 1.94, 1.5), seg="poster"
    )
    builder.add_light(0, Light((-0.5, -0.4, 2.4)))
    builder.add_light(0, Light((1.5, 1.0, 2.3), (1.0, 0.8, 0.6), 0.5))
    return builder


def drawn(view: str) -> dict[str, np.ndarray]:
    eye, target, fovy, quality = VIEWS[view]
    images = Rasterizer(room().build(), 1).render(
        np.zeros(1, int),
        np.zeros((1, 1, 3)),
        np.eye(3)[None, None],
        Cameras(
            np.array(eye)[None, None], look_at(eye, target)[None, None], fovy, SIZE, SIZE
        ),
        quality=quality,
    )
    return {name: image[0, 0] for name, image in images.items()}


def stored(view: str, images: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The golden pictures of a view; with ``MJHAB_UPDATE_GOLDEN`` they are first made from ``images``."""
    if os.environ.get("MJHAB_UPDATE_GOLDEN"):
        FOLDER.mkdir(exist_ok=True)
        Image.fromarray(images["rgb"]).save(FOLDER / f"{view}_rgb.png", optimize=True)
        depth = np.round(images["depth"] / DEPTH_STEP).clip(0, 65535).astype(np.uint16)
        Image.fromarray(depth).save(FOLDER / f"{view}_depth.png", optimize=True)
        Image.fromarray(images["seg"].astype(np.uint8)).save(
            FOLDER / f"{view}_seg.png", optimize=True
        )
    files = {name: FOLDER / f"{view}_{name}.png" for name in ("rgb", "depth", "seg")}
    return {
        name: np.asarray(Image.open(file)).astype(np.float64)
        for name, file in files.items()
    }


@pytest.mark.parametrize("view", VIEWS)
def test_pictures_look_as_they_did(view: str) -> None:
    images = drawn(view)
    golden = stored(view, images)
    rgb = np.abs(images["rgb"] - golden["rgb"]).max(axis=2)
    assert rgb.mean() < 0.5 and (rgb <= 4).mean() > 0.99
    assert (images["seg"] == golden["seg"]).mean() > 0.998
    depth = np.abs(images["depth"] - golden["depth"] * DEPTH_STEP)
    assert np.median(depth) < 1.1 * DEPTH_STEP / 2 and (depth < 0.001).mean() > 0.998


def test_the_golden_views_show_what_they_are_for() -> None:
    seen = set()
    for view in VIEWS:
        seen |= set(
            np.unique(np.asarray(Image.open(FOLDER / f"{view}_seg.png"))).tolist()
        )
    names = room().build().seg_names
    assert {names[k] for k in seen} == set(names)
