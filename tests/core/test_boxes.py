"""Distances to boxes: the compiled search for the nearest one agrees with all distances."""

from __future__ import annotations

import numpy as np

from mjhab.core.boxes import Boxes, nearest_box_distance, sphere_box_distance
from mjhab.core.rotations import mat_from_quat


def test_the_nearest_box_is_the_least_of_all_distances() -> None:
    rng = np.random.default_rng(0)
    quat = rng.normal(size=(12, 4))
    turn = mat_from_quat(quat / np.linalg.norm(quat, axis=1, keepdims=True))
    boxes = Boxes.of(rng.uniform(-1, 1, (12, 3)), rng.uniform(0.02, 0.5, (12, 3)), turn)
    points = rng.uniform(-2, 2, (500, 3))
    wanted = sphere_box_distance(points, boxes).min(axis=1)
    assert (wanted < 0.0).any() and (wanted > 0.5).any()
    np.testing.assert_allclose(nearest_box_distance(points, boxes), wanted, atol=1e-12)


def test_nothing_is_near_without_boxes() -> None:
    assert np.isinf(nearest_box_distance(np.zeros((3, 3)), Boxes.join(()))).all()
