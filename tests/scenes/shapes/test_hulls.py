"""Boxes around convex pieces, and vertical lines through them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.core.rotations import mat_from_quat
from mjhab.scenes.shapes.hulls import boxed_hull, hull_mesh, smallest_box, vertical_extent
from mjhab.scenes.spec import Geom, Pack
from tests.scenes.formats.glb import BOX

quats = st.tuples(*[st.floats(-1, 1) for _ in range(4)]).filter(
    lambda q: np.linalg.norm(q) > 0.1
)


@settings(max_examples=30, deadline=None)
@given(quat=quats, half=st.tuples(*[st.floats(0.02, 1.0) for _ in range(3)]))
def test_the_box_of_a_box_is_that_box(
    quat: tuple[float, ...], half: tuple[float, ...]
) -> None:
    rot = mat_from_quat(np.array(quat) / np.linalg.norm(quat))
    center, found, turn = smallest_box(BOX * half @ rot.T + [1, 2, 3])
    assert np.allclose(center, [1, 2, 3], atol=1e-6)
    assert np.allclose(np.sort(found), np.sort(half), atol=1e-5)
    assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-9) and np.linalg.det(
        turn
    ) == pytest.approx(1)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_a_box_holds_all_points(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(20, 3))
    center, half, rot = smallest_box(points)
    assert (np.abs((points - center) @ rot) <= half + 1e-9).all()
    assert 8 * half.prod() <= np.ptp(points, axis=0).prod() * (1 + 1e-9)


def test_boxed_hull_keeps_the_pose_of_the_geom() -> None:
    mesh = hull_mesh(BOX * [1, 0.5, 0.25] + [1, 0, 0])
    pack = Pack("p", {}, {}, (), {}, {"m": mesh})
    geom = Geom(
        "mesh", (1.0, 1.0, 1.0), (0, 0, 5), (np.sqrt(0.5), 0, 0, np.sqrt(0.5)), mesh="m"
    )
    box = boxed_hull(geom, pack)
    assert box.shape == "box" and np.allclose(box.pos, [0, 1, 5], atol=1e-6)
    assert np.allclose(np.sort(box.size), [0.25, 0.5, 1.0], atol=1e-6)


def test_hull_meshes_are_closed_and_face_outward() -> None:
    mesh = hull_mesh(np.concatenate([BOX, np.zeros((3, 3))]))
    assert len(mesh.vertices) == 8 and len(mesh.faces) == 12
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    assert (np.einsum("fk,fk->f", np.cross(b - a, c - a), (a + b + c) / 3) > 0).all()


def test_vertical_lines_enter_and_leave() -> None:
    low, high = vertical_extent(
        np.concatenate([BOX[:, :], [[0, 0, 2]]]), np.array([[0, 0], [0.5, 0], [3, 0]])
    )
    assert np.allclose(low, [-1, -1, np.inf]) and np.allclose(high, [2, 1.5, -np.inf])
