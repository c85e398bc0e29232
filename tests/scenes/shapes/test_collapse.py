"""Collapsing of edges: fewer faces, the same shape, seams and borders where they were."""

from __future__ import annotations

import numpy as np
import pytest

from mjhab.scenes.shapes.collapse import collapse, distance_to_faces


def grid(side: int, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a sheet of side x side points over the unit square."""
    y, x = np.mgrid[0 : 1 : side * 1j, 0 : 1 : side * 1j]
    k = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([k, k + 1, k + side], 1),
            np.stack([k + 1, k + side + 1, k + side], 1),
        ]
    )
    return np.stack([x.ravel(), y.ravel(), height.ravel()], 1), faces


def area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_a_flat_sheet_keeps_its_border_and_area() -> None:
    vertices, faces = grid(12, np.zeros((12, 12)))
    ((few, merged),) = collapse(vertices, faces, [40])
    assert len(few.faces) <= 40
    assert area(few.vertices, few.faces) == pytest.approx(1.0, abs=1e-3)
    assert np.abs(few.vertices[:, 2]).max() < 1e-9
    assert few.vertices[:, :2].min() > -1e-3 and few.vertices[:, :2].max() < 1 + 1e-3
    assert len(merged) == len(vertices) and merged.max() == len(few.vertices) - 1


def test_a_fold_stays_sharp() -> None:
    x = np.linspace(0, 1, 13)
    vertices, faces = grid(13, np.tile(np.abs(x - 0.5), (13, 1)))
    ((few, _),) = collapse(vertices, faces, [60])
    # All points are still on one of the two planes.
    off = np.abs(few.vertices[:, 2] - np.abs(few.vertices[:, 0] - 0.5))
    assert off.max() < 0.01
    assert few.vertices[:, 2].min() < 0.01


def test_levels_follow_each_other_and_name_the_faces_they_keep() -> None:
    rng = np.random.default_rng(0)
    vertices, faces = grid(14, 0.05 * rng.normal(size=(14, 14)))
    levels = collapse(vertices, faces, [150, 70, 30])
    assert [
        len(few.faces) <= n for (few, _), n in zip(levels, (150, 70, 30), strict=True)
    ]
    for few, merged in levels:
        # A corner of a kept face is the vertex that its own has been merged into.
        np.testing.assert_array_equal(merged[faces[few.source]], few.faces)
    again = collapse(vertices, faces, [150, 70, 30])
    np.testing.assert_array_equal(again[-1][0].vertices, levels[-1][0].vertices)


def test_distance_to_a_triangle() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    points = np.array(
        [[0.2, 0.2, 0.3], [2.0, 0, 0], [-1, -1, 0], [0.5, -0.5, 0], [1, 1, 0]]
    )
    want = [0.3, 1.0, np.sqrt(2), 0.5, np.sqrt(0.5)]
    got = distance_to_faces(points, np.tile(corners, (5, 1, 1)))
    np.testing.assert_allclose(got, want, atol=1e-12)
    flat = np.zeros((1, 3, 3))
    np.testing.assert_allclose(distance_to_faces(np.array([[3.0, 4, 0]]), flat), [5.0])
