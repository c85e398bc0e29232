"""Reader of binary glTF, and painting of faces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.core.errors import UsageError
from mjhab.scenes.gltf import read_glb, read_hulls
from mjhab.scenes.painting import painted_mesh
from tests.scenes.glb import BOX, BOX_FACES, box_glb, write_glb

QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]], float)
QUAD_FACES = np.array([[0, 2, 1], [0, 3, 2]])
QUAD_UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)


def area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("fk,fk->", a, np.cross(b, c)) / 6)


def test_node_transforms_of_parents_and_children_apply_in_order(tmp_path: Path) -> None:
    nodes = [
        {"scale": [0.01, 0.01, 0.01], "translation": [0, 3, 0], "children": [1]},
        {"mesh": 0, "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)], "translation": [100, 0, 0]},
    ]
    (part,) = read_glb(write_glb(tmp_path / "a.glb", [(BOX * [3, 2, 1], BOX_FACES)], nodes))
    # A quarter turn about z swaps x and y; the outer node scales centimetres and lifts.
    assert np.allclose(part.vertices.min(0), [0.98, 2.97, -0.01])
    assert np.allclose(part.vertices.max(0), [1.02, 3.03, 0.01])


def test_a_mirroring_node_keeps_the_outside_outside(tmp_path: Path) -> None:
    plain = read_glb(write_glb(tmp_path / "a.glb", [(BOX, BOX_FACES)]))[0]
    nodes = [{"mesh": 0, "scale": [-2, 1, 1]}]
    mirrored = read_glb(write_glb(tmp_path / "b.glb", [(BOX, BOX_FACES)], nodes))[0]
    assert volume(plain.vertices, plain.faces) == pytest.approx(8)
    assert volume(mirrored.vertices, mirrored.faces) == pytest.approx(16)


def test_hulls_are_read_one_per_mesh_with_their_distinct_points(tmp_path: Path) -> None:
    corners = BOX[BOX_FACES.ravel()]
    faces = np.arange(len(corners)).reshape(-1, 3)
    hulls = read_hulls(write_glb(tmp_path / "a.glb", [(corners, faces), (corners * 0.5 + 4, faces)]))
    assert [h.shape for h in hulls] == [(8, 3), (8, 3)]
    assert np.allclose(hulls[1].mean(0), 4)
    with pytest.raises(UsageError, match=r"flat\.glb: mesh 'part_0' has 3 distinct points"):
        read_hulls(write_glb(tmp_path / "flat.glb", [(BOX[:3], np.array([[0, 1, 2]]))]))


@settings(max_examples=40, deadline=None)
@given(share=st.floats(0.0, 0.999))
def test_any_cut_off_file_is_one_error_that_names_it(share: float, tmp_path_factory: pytest.TempPathFactory) -> None:
    whole = box_glb(tmp_path_factory.mktemp("glb") / "thing.glb", (1, 2, 3))
    raw = whole.read_bytes()
    whole.write_bytes(raw[: int(share * len(raw))])
    with pytest.raises(UsageError, match=r"thing\.glb: .*fetch (the file|it) again") as error:
        read_glb(whole)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'"POSITION"', b'"POSITIOM"', "POSITION"),
        (b'"componentType"', b'"componentTypo"', "componentType"),
        (b'"byteOffset": 0, "byteLength": 96', b'"byteOffset":999, "byteLength": 9', "past the end"),
        (b'{"asset"', b'["asset"', "JSON chunk is broken"),
    ],
)
def test_a_broken_document_is_one_error(old: bytes, new: bytes, message: str, tmp_path: Path) -> None:
    path = box_glb(tmp_path / "thing.glb", (1, 2, 3))
    raw = path.read_bytes()
    assert old in raw and len(old) == len(new)
    path.write_bytes(raw.replace(old, new))
    with pytest.raises(UsageError, match=message) as error:
        read_glb(path)
    assert "thing.glb" in str(error.value)


def test_missing_files_and_other_files_say_so(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no\.glb: cannot be read"):
        read_glb(tmp_path / "no.glb")
    (tmp_path / "text.glb").write_text("version https://git-lfs.github.com/spec/v1 and so on")
    with pytest.raises(UsageError, match="not a binary glTF file"):
        read_glb(tmp_path / "text.glb")


def test_a_textured_quad_is_cut_where_its_picture_changes(tmp_path: Path) -> None:
    image = np.full((64, 64, 3), 200, np.uint8)
    image[:, :21] = (200, 0, 0)
    path = write_glb(tmp_path / "a.glb", [(QUAD, QUAD_FACES)], uv=QUAD_UV, image=image)
    mesh = painted_mesh(read_glb(path), 600)
    assert mesh.face_color is not None and len(mesh.faces) > 100
    # A sheet is there twice, once for each side; both sides together have twice its area.
    assert area(mesh.vertices, mesh.faces) == pytest.approx(2.0, rel=1e-5)
    x = mesh.vertices[mesh.faces].mean(1)[:, 0]
    red = mesh.face_color[:, 1] < 0.2
    assert (x[red] < 0.36).all() and red[x < 0.3].all()
    # Far from the red stripe nothing is cut.
    corners = mesh.vertices[mesh.faces]
    assert area(mesh.vertices, mesh.faces[(corners[..., 0] > 0.45).any(axis=1)]) > 1.0
    assert (corners[..., 0] > 0.6).any(axis=1).sum() < 30


def test_closed_bodies_are_drawn_from_outside_only(tmp_path: Path) -> None:
    mesh = painted_mesh(read_glb(box_glb(tmp_path / "a.glb", (1, 1, 1))), 500)
    assert len(mesh.faces) == 12
    assert mesh.face_color is not None and np.allclose(mesh.face_color, 1.0)


def test_texture_transform_moves_the_picture(tmp_path: Path) -> None:
    image = np.zeros((4, 4, 3), np.uint8)
    image[:, 2:] = 255
    moved = write_glb(
        tmp_path / "a.glb", [(QUAD, QUAD_FACES)], uv=QUAD_UV * 0.4, image=image, transform={"offset": [0.55, 0.0]}
    )
    color = painted_mesh(read_glb(moved), 0).face_color
    assert color is not None and np.allclose(color, 1.0)
