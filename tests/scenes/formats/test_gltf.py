"""Reader of binary glTF, and painting of faces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.scenes.formats.gltf import read_glb, read_hulls
from mjhab.scenes.shapes.painting import TEXELS_PER_M, textured_mesh
from tests.refusals import refused
from tests.scenes.formats.glb import BOX, BOX_FACES, box_glb, write_glb

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
        {
            "mesh": 0,
            "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)],
            "translation": [100, 0, 0],
        },
    ]
    (part,) = read_glb(
        write_glb(tmp_path / "a.glb", [(BOX * [3, 2, 1], BOX_FACES)], nodes)
    )
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
    hulls = read_hulls(
        write_glb(tmp_path / "a.glb", [(corners, faces), (corners * 0.5 + 4, faces)])
    )
    assert [h.shape for h in hulls] == [(8, 3), (8, 3)]
    assert np.allclose(hulls[1].mean(0), 4)
    with refused(where="flat.glb", said="mesh 'part_0' has 3 distinct points"):
        read_hulls(write_glb(tmp_path / "flat.glb", [(BOX[:3], np.array([[0, 1, 2]]))]))


@settings(max_examples=40, deadline=None)
@given(share=st.floats(0.0, 0.999))
def test_any_cut_off_file_is_one_error_that_names_it(
    share: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    whole = box_glb(tmp_path_factory.mktemp("glb") / "thing.glb", (1, 2, 3))
    raw = whole.read_bytes()
    whole.write_bytes(raw[: int(share * len(raw))])
    with refused(where="thing.glb", said=("download", "again")) as error:
        read_glb(whole)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'"POSITION"', b'"POSITIOM"', "POSITION"),
        (b'"componentType"', b'"componentTypo"', "componentType"),
        (
            b'"byteOffset": 0, "byteLength": 96',
            b'"byteOffset":999, "byteLength": 9',
            "past the end",
        ),
        (b'{"asset"', b'["asset"', "JSON chunk is broken"),
    ],
)
def test_a_broken_document_is_one_error(
    old: bytes, new: bytes, message: str, tmp_path: Path
) -> None:
    path = box_glb(tmp_path / "thing.glb", (1, 2, 3))
    raw = path.read_bytes()
    assert old in raw and len(old) == len(new)
    path.write_bytes(raw.replace(old, new))
    with refused(said=message) as error:
        read_glb(path)
    assert "thing.glb" in str(error.value)


def test_missing_files_and_other_files_say_so(tmp_path: Path) -> None:
    with refused(where="no.glb", said="cannot be read"):
        read_glb(tmp_path / "no.glb")
    (tmp_path / "text.glb").write_text(
        "version https://git-lfs.github.com/spec/v1 and so on"
    )
    with refused(where="text.glb", said="not a binary glTF file"):
        read_glb(tmp_path / "text.glb")


def test_a_textured_quad_keeps_its_picture_on_both_sides(tmp_path: Path) -> None:
    image = np.full((64, 64, 3), 200, np.uint8)
    image[:, :32] = (200, 0, 0)
    path = write_glb(tmp_path / "a.glb", [(QUAD, QUAD_FACES)], uv=QUAD_UV, image=image)
    mesh = textured_mesh(read_glb(path))
    # A sheet is there twice, once for each side; both sides together have twice its area.
    assert len(mesh.faces) == 2 * len(QUAD_FACES)
    assert area(mesh.vertices, mesh.faces) == pytest.approx(2.0, rel=1e-5)
    assert mesh.uv is not None and mesh.face_texture is not None
    np.testing.assert_array_equal(mesh.face_texture, 0)
    np.testing.assert_array_equal(mesh.textures[0], image)
    # Every corner of both sides keeps its place in the picture.
    want = {
        tuple(p): tuple(q)
        for p, q in zip(QUAD.round(5).tolist(), QUAD_UV.tolist(), strict=True)
    }
    for face, uv in zip(mesh.faces, mesh.uv, strict=True):
        for corner, place in zip(mesh.vertices[face].round(5).tolist(), uv, strict=True):
            np.testing.assert_allclose(place, want[tuple(corner)], atol=1e-6)


def test_textures_become_no_finer_than_can_be_seen(tmp_path: Path) -> None:
    image = np.zeros((64, 128, 3), np.uint8)
    image[::2] = 100
    small = write_glb(
        tmp_path / "a.glb", [(QUAD * 0.02, QUAD_FACES)], uv=QUAD_UV, image=image
    )
    (shrunk,) = textured_mesh(read_glb(small)).textures
    assert shrunk.shape == (16, 32, 3) and (shrunk == 50).all()
    # 16 x 32 texels on 2 cm: the next finer picture would be above the limit.
    assert np.sqrt(16 * 32) / 0.02 < TEXELS_PER_M < np.sqrt(32 * 64) / 0.02


def test_odd_textures_are_brought_to_powers_of_two(tmp_path: Path) -> None:
    image = np.full((50, 700, 3), 77, np.uint8)
    path = write_glb(tmp_path / "a.glb", [(QUAD, QUAD_FACES)], uv=QUAD_UV, image=image)
    texture = read_glb(path)[0].texture
    assert texture is not None and texture.shape == (32, 512, 3) and (texture == 77).all()


def test_closed_bodies_are_drawn_from_outside_only(tmp_path: Path) -> None:
    mesh = textured_mesh(read_glb(box_glb(tmp_path / "a.glb", (1, 1, 1))))
    assert len(mesh.faces) == 12 and not mesh.textures
    assert mesh.face_color is not None and np.allclose(mesh.face_color, 1.0)


def test_texture_transform_moves_the_picture(tmp_path: Path) -> None:
    image = np.zeros((4, 4, 3), np.uint8)
    moved = write_glb(
        tmp_path / "a.glb",
        [(QUAD, QUAD_FACES)],
        uv=QUAD_UV * 0.4,
        image=image,
        transform={"offset": [0.55, 0.0]},
    )
    uv = textured_mesh(read_glb(moved)).uv
    assert uv is not None
    np.testing.assert_allclose(
        [uv[..., 0].min(), uv[..., 0].max()], [0.55, 0.95], atol=1e-6
    )
    np.testing.assert_allclose(
        [uv[..., 1].min(), uv[..., 1].max()], [0.0, 0.4], atol=1e-6
    )


@pytest.mark.parametrize("value", [np.nan, 1e30])
def test_vertices_that_are_nowhere(value: float, tmp_path: Path) -> None:
    vertices = QUAD.copy()
    vertices[1, 2] = value
    path = write_glb(tmp_path / "a.glb", [(vertices, QUAD_FACES)])
    with refused(where="a.glb", said=("mesh", "has vertices that are not finite")):
        read_glb(path)
