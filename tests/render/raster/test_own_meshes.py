"""Meshes of files wound inwards, double-sided or mirrored look like the good ones: CPU renderer and viewer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mjhab.render.build_scene import SceneBuilder
from mjhab.render.cameras import Cameras, look_at
from mjhab.render.models import home_models
from mjhab.render.raster.rasterizer import Rasterizer
from mjhab.scenes.replica_cad.looks import MeshFiles
from mjhab.scenes.shapes.meshes import Mesh
from tests.render.own_meshes import CUBES, HALF_M, cube
from tests.render.raster.test_rasterizer import box_depth, rays
from tests.scenes.formats.glb import BOX, BOX_FACES, write_glb

EYE = np.array([0.21, -0.16, 0.13])
SIZE = (40, 40)
FOVY = 0.5
DEPTH_M = 1e-5
"""Tolerance of the depth; the inside of the cube is 24 mm to 58 mm farther away."""


def drawn(
    mesh: Mesh, scale: tuple[float, float, float] = (1, 1, 1)
) -> dict[str, np.ndarray]:
    """Images (h, w[, 3]) of a mesh at the origin."""
    builder = SceneBuilder(1)
    builder.add_world_instance(builder.add_mesh("own", mesh), (0, 0, 0), scale=scale)
    raster = Rasterizer(builder.build(), 1)
    camera = look_at(EYE, (0, 0, 0))[None, None]
    images = raster.render(
        np.array([0]),
        np.zeros((1, 1, 3)),
        np.eye(3)[None, None],
        Cameras(EYE[None, None], camera, FOVY, *SIZE),
    )
    return {name: image[0, 0] for name, image in images.items()}


def expected() -> np.ndarray:
    return box_depth(EYE, rays(EYE, (0, 0, 0), SIZE, FOVY), (0, 0, 0), HALF_M)


@pytest.mark.parametrize("name", sorted(CUBES))
def test_the_outside_of_a_cube_is_drawn(name: str, tmp_path: Path) -> None:
    model = cube(name, tmp_path)
    images = drawn(model.meshes[f"{name}_cube/look"])  # type: ignore[arg-type]
    want = expected()
    assert (want > 0).sum() > 300
    np.testing.assert_allclose(images["depth"], want, atol=DEPTH_M)
    good = drawn(cube("good", tmp_path).meshes["good_cube/look"])  # type: ignore[arg-type]
    np.testing.assert_array_equal(images["rgb"], good["rgb"])


@pytest.mark.parametrize("scale", [(-1, 1, 1), (-1, -1, -1), (1, 1, 1)])
@pytest.mark.parametrize("inward", [False, True])
def test_a_mesh_of_any_origin_and_a_negative_scale(
    scale: tuple[float, float, float], inward: bool
) -> None:
    faces = BOX_FACES[:, ::-1] if inward else BOX_FACES
    mesh = Mesh((BOX * HALF_M).astype(np.float32), faces.astype(np.int32))
    np.testing.assert_allclose(drawn(mesh, scale)["depth"], expected(), atol=DEPTH_M)


def test_a_mirrored_visual_of_furniture(tmp_path: Path) -> None:
    """A URDF gives its meshes a scale, which may be negative."""
    file = write_glb(tmp_path / "a.glb", [(BOX * HALF_M, BOX_FACES)])
    looks = MeshFiles()
    looks.add("piece", file, np.diag([-1.0, 1.0, 1.0, 1.0]))
    np.testing.assert_allclose(
        drawn(looks.meshes()["piece"])["depth"], expected(), atol=DEPTH_M
    )


@pytest.mark.parametrize("double_sided", [False, True])
def test_a_sheet_is_seen_from_both_sides(double_sided: bool, tmp_path: Path) -> None:
    """An open surface has a visible back, whatever its material says."""
    quad = np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]]) * HALF_M
    for faces in ([[0, 1, 2], [0, 2, 3]], [[0, 2, 1], [0, 3, 2]]):
        file = write_glb(
            tmp_path / "a.glb", [(quad, np.array(faces))], double_sided=double_sided
        )
        looks = MeshFiles()
        looks.add(f"quad {faces} {double_sided}", file, np.eye(4))
        (mesh,) = looks.meshes().values()
        assert (drawn(mesh)["depth"] > 0).sum() > 100


@pytest.mark.parametrize("scale", [(1, 1, 1), (-1, 1, 1)])
def test_the_viewer_gets_faces_that_a_browser_does_not_cull(
    scale: tuple[float, float, float],
) -> None:
    mesh = Mesh((BOX * HALF_M).astype(np.float32), BOX_FACES[:, ::-1].astype(np.int32))
    builder = SceneBuilder(1)
    builder.add_world_instance(builder.add_mesh("own", mesh), (0, 0, 0), scale=scale)
    (part,) = home_models(builder.build(), 0).home.parts
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert (np.einsum("fk,fk->f", normal, (a + b + c) / 3) > 0).all()
    assert (np.einsum("fk,fk->f", normal, part.normals[part.faces[:, 0]]) > 0).all()
