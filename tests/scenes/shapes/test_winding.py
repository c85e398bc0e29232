"""Closed surfaces are turned outwards, and the faces of open ones are found, however a file winds them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.render.mesh_levels import MIN_FACES, mesh_levels
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.shapes.winding import find_winding, turned_outwards
from tests.scenes.formats.glb import BOX, BOX_FACES

FACES = BOX_FACES.astype(np.int64)
SHAPES = {
    "box": trimesh.creation.box((0.06, 0.06, 0.06)),
    "ring": trimesh.creation.annulus(0.03, 0.05, 0.02),
    "ball": trimesh.creation.icosphere(2, 0.03),
}


def volume(points: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (points[faces[:, k]] for k in range(3))
    return float(np.einsum("fk,fk->", a, np.cross(b, c)) / 6)


def soup(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same faces with vertices of their own, as STL files and texture seams have them."""
    return points[faces.ravel()], np.arange(faces.size).reshape(-1, 3)


@settings(max_examples=40, deadline=None)
@given(
    name=st.sampled_from(sorted(SHAPES)),
    seed=st.integers(0, 99),
    size=st.sampled_from([1e-3, 1.0, 50.0]),
    apart=st.booleans(),
)
def test_a_solid_wound_at_random_is_turned_outwards(
    name: str, seed: int, size: float, apart: bool
) -> None:
    shape = SHAPES[name]
    rng = np.random.default_rng(seed)
    points = np.asarray(shape.vertices) * size + rng.normal(size=3)
    faces = np.asarray(shape.faces)
    flipped = rng.random(len(faces)) < rng.choice([0.0, 0.5, 1.0])
    wound = np.where(flipped[:, None], faces[:, ::-1], faces)
    if apart:
        points, wound = soup(points, wound)
    turned, winding = turned_outwards(points, wound)
    assert np.array_equal(winding.flipped, flipped) and not winding.sheet.any()
    assert volume(points, turned) == pytest.approx(shape.volume * size**3, rel=1e-6)


def test_solids_that_touch_in_an_edge_are_turned_one_by_one() -> None:
    points = np.concatenate([BOX, BOX + np.array([2, 2, 0])])
    faces = np.concatenate([FACES, FACES[:, ::-1] + 8])
    winding = find_winding(points, faces)
    assert np.array_equal(winding.flipped, np.arange(24) >= 12)
    assert not winding.sheet.any()


def test_an_open_box_is_a_sheet_and_a_closed_one_beside_it_is_not() -> None:
    points = np.concatenate([BOX, BOX + 9.0])
    faces = np.concatenate([FACES[2:], FACES + 8])
    winding = find_winding(points, faces)
    assert np.array_equal(winding.sheet, np.arange(22) < 10)
    assert not winding.flipped.any()


def test_a_band_with_one_side_is_a_sheet() -> None:
    """A Moebius band, closed by nothing: no winding of it is right."""
    t = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    width = np.array([-0.01, 0.01])[:, None]
    out = 0.05 + width * np.cos(t / 2)
    points = np.stack(
        [out * np.cos(t), out * np.sin(t), width * np.sin(t / 2)], -1
    ).reshape(-1, 3)
    k = np.arange(24)
    low, high = k, k + 24
    turn = k == 23
    low_next = np.where(turn, 24, (k + 1) % 24)
    high_next = np.where(turn, 0, (k + 1) % 24 + 24)
    faces = np.concatenate(
        [np.stack([low, low_next, high_next], 1), np.stack([low, high_next, high], 1)]
    )
    winding = find_winding(points, faces)
    assert winding.sheet.all() and not winding.flipped.any()


def test_faces_that_have_their_other_side_in_the_file_stay() -> None:
    sheet = FACES[:2]
    both = np.concatenate([sheet, sheet[:, ::-1]])
    winding = find_winding(BOX, both)
    assert not winding.flipped.any() and not winding.sheet.any()


def test_nothing_and_faces_without_area_are_no_error() -> None:
    assert len(find_winding(BOX, np.zeros((0, 3), int)).sheet) == 0
    winding = find_winding(BOX, np.concatenate([FACES, [[0, 0, 1], [3, 3, 3]]]))
    assert not winding.flipped.any() and not winding.sheet[:12].any()


@pytest.mark.parametrize("name", ["box", "ball"])
def test_levels_of_detail_of_a_mesh_wound_inwards_are_those_of_the_good_one(
    name: str,
) -> None:
    """Robots, packs and plugins bring meshes of their own; both renderers and the viewer draw these levels."""
    shape = SHAPES[name]
    points = np.asarray(shape.vertices, np.float32)
    good = np.asarray(shape.faces, np.int32)
    uv = np.random.default_rng(0).random((len(good), 3, 2)).astype(np.float32)
    texture = np.zeros(len(good), np.int32)
    image = (np.zeros((8, 8, 3), np.uint8),)
    assert (len(good) >= MIN_FACES) == (name == "ball")
    made = [
        mesh_levels(Mesh(points, faces, None, corners, texture, image))
        for faces, corners in ((good, uv), (good[:, ::-1].copy(), uv[:, ::-1].copy()))
    ]
    assert len(made[0]) == len(made[1])
    for want, got in zip(*made, strict=True):
        assert np.array_equal(want.faces, got.faces)
        np.testing.assert_allclose(want.normal, got.normal, atol=1e-5)
        np.testing.assert_allclose(want.uv, got.uv, atol=1e-5)
