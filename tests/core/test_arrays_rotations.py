"""Array helpers and rotations against closed forms, on numpy and torch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch

from mjhab.core import rotations as rot
from mjhab.core.arrays import (
    as_like,
    cast,
    constant,
    join_as,
    namespace,
    object_array,
    pick_column,
    pile,
    to_numpy,
    where_rows,
)
from tests.tasks.build import assert_same

RNG = np.random.default_rng(0)


def random_quats(n: int) -> np.ndarray:
    q = RNG.normal(size=(n, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def test_products_match_matrices() -> None:
    a = random_quats(50)
    b = random_quats(50)
    v = RNG.normal(size=(50, 3))
    ma = rot.mat_from_quat(a)
    mb = rot.mat_from_quat(b)
    np.testing.assert_allclose(rot.mat_from_quat(rot.quat_mul(a, b)), ma @ mb, atol=1e-12)
    np.testing.assert_allclose(
        rot.quat_rotate(a, v), np.einsum("nij,nj->ni", ma, v), atol=1e-12
    )
    np.testing.assert_allclose(
        rot.quat_rotate_inv(a, rot.quat_rotate(a, v)), v, atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(ma), 1.0)


def test_matrix_to_quaternion_in_all_four_branches() -> None:
    halves = [
        [1, 0, 0, 0],
        [0, 1, 0, 0],
        [0, 0, 1, 0],
        [0, 0, 0, 1],
        [0.5, -0.5, 0.5, 0.5],
    ]
    q = np.concatenate([random_quats(200), np.array(halves, dtype=float)])
    back = rot.quat_from_mat(rot.mat_from_quat(q))
    assert (back[:, 0] >= 0).all()
    np.testing.assert_allclose(np.abs(np.sum(back * q, axis=1)), 1.0, atol=1e-12)


@pytest.mark.parametrize("library", [np.asarray, torch.from_numpy])
def test_canonical_quaternions(library: Any) -> None:
    """One of q and -q, the same for both: the first component that is not 0 is positive."""
    edges = [[0, -1, 0, 0], [0, 0, -0.6, 0.8], [-0.0, 0.6, -0.8, 0], [0, 0, 0, -1], [-0.5, 0.5, 0.5, 0.5], [0, 0, 0, 0],
             [-1e-300, 1, 0, 0]]  # fmt: skip
    q = np.concatenate([random_quats(100), np.array(edges, float)]).reshape(1, -1, 4)
    for dtype in (np.float64, np.float32):
        one = to_numpy(rot.quat_canonical(library(q.astype(dtype))))
        assert one.dtype == dtype and one.shape == q.shape
        np.testing.assert_array_equal(
            one, to_numpy(rot.quat_canonical(library(-q.astype(dtype))))
        )
        np.testing.assert_array_equal(one, to_numpy(rot.quat_canonical(library(one))))
        np.testing.assert_array_equal(np.abs(one), np.abs(q.astype(dtype)))
        first = [next((x for x in row if x != 0), 0.0) for row in one[0]]
        assert min(first) == 0.0 and first.count(0.0) == 1
        agree = (one * q.astype(dtype)).sum(axis=-1)
        np.testing.assert_allclose(np.abs(agree[agree != 0]), 1.0, atol=1e-6)


def test_yaw_and_axis_angle() -> None:
    yaw = np.array([-3.0, -0.5, 0.0, 1.0, 3.0])
    np.testing.assert_allclose(rot.yaw_from_quat(rot.quat_from_yaw(yaw)), yaw, atol=1e-12)
    z = np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(
        rot.quat_from_axis_angle(z, yaw), rot.quat_from_yaw(yaw), atol=1e-12
    )
    quarter = rot.quat_from_axis_angle(np.array([1.0, 0.0, 0.0]), np.array(math.pi / 2))
    np.testing.assert_allclose(
        rot.quat_rotate(quarter, np.array([0.0, 1.0, 0.0])), [0, 0, 1], atol=1e-12
    )


def test_poses_compose_invert_and_map_points() -> None:
    a = np.concatenate([RNG.normal(size=(20, 3)), random_quats(20)], axis=1)
    b = np.concatenate([RNG.normal(size=(20, 3)), random_quats(20)], axis=1)
    p = RNG.normal(size=(20, 3))

    def mapped(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
        return pose[..., :3] + rot.quat_rotate(pose[..., 3:], points)

    both = mapped(rot.pose_mul(a, b), p)
    np.testing.assert_allclose(both, mapped(a, mapped(b, p)), atol=1e-12)
    unit = np.tile([0.0, 0, 0, 1, 0, 0, 0], (20, 1))
    np.testing.assert_allclose(rot.pose_mul(a, rot.pose_inv(a)), unit, atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_torch_rotates_the_same_in_value_and_dtype(dtype: Any) -> None:
    q = random_quats(30).astype(dtype)
    r = random_quats(30).astype(dtype)
    v = RNG.normal(size=(30, 3)).astype(dtype)
    yaw = RNG.normal(size=30).astype(dtype)
    t = torch.from_numpy
    tol = 1e-6 if dtype == np.float32 else 1e-12
    pose = np.concatenate([v, q], 1)
    other = np.concatenate([v, r], 1)
    pairs = [
        (rot.quat_mul(q, r), rot.quat_mul(t(q), t(r))),
        (rot.quat_rotate(q, v), rot.quat_rotate(t(q), t(v))),
        (rot.quat_rotate_inv(q, v), rot.quat_rotate_inv(t(q), t(v))),
        (rot.mat_from_quat(q), rot.mat_from_quat(t(q))),
        (
            rot.quat_from_mat(rot.mat_from_quat(q)),
            rot.quat_from_mat(t(rot.mat_from_quat(q))),
        ),
        (rot.quat_from_yaw(yaw), rot.quat_from_yaw(t(yaw))),
        (rot.yaw_from_quat(q), rot.yaw_from_quat(t(q))),
        (rot.quat_from_axis_angle(v, yaw), rot.quat_from_axis_angle(t(v), t(yaw))),
        (rot.pose_mul(pose, other), rot.pose_mul(t(pose), t(other))),
        (rot.pose_inv(pose), rot.pose_inv(t(pose))),
    ]
    for index, (a, b) in enumerate(pairs):
        assert a.dtype == dtype
        assert_same(a, b, str(index), tol)


@dataclass(frozen=True)
class _Record:
    a: Any
    b: Any
    c: Any = None


def test_array_helpers() -> None:
    table = np.arange(12).reshape(3, 4)
    assert pick_column(table, np.array([1, 0, 3])).tolist() == [1, 4, 11]
    assert pick_column(torch.from_numpy(table), torch.tensor([1, 0, 3])).tolist() == [
        1,
        4,
        11,
    ]
    mask = np.array([True, False])
    mixed = where_rows(
        mask,
        _Record(np.ones(2), np.ones((2, 2, 2))),
        _Record(np.zeros(2), np.zeros((2, 2, 2))),
    )
    assert mixed.a.tolist() == [1, 0] and mixed.b.sum() == 4 and mixed.c is None
    assert to_numpy(torch.ones(2)).tolist() == [1, 1]
    assert as_like([1, 2], torch.zeros(1, dtype=torch.float32)).dtype == torch.float32
    assert constant((1.0, 2.0), table * 1.0) is constant((1.0, 2.0), table * 1.0)
    with pytest.raises(TypeError):
        namespace(np.ones(1), torch.ones(1))


@pytest.mark.parametrize("library", [np, torch])
def test_rows_and_columns_are_joined_the_same_in_both_libraries(library: Any) -> None:
    one = library.asarray([0.1, 2.0, 3.0], dtype=library.float64)
    two = library.asarray([4.0, 5.0, 6.0], dtype=library.float64)
    yes = library.asarray([True, False, True])
    assert to_numpy(pile((one, two))).tolist() == [[0.1, 2.0, 3.0], [4.0, 5.0, 6.0]]
    joined = to_numpy(join_as((one[:, None], yes[:, None]), library.float32))
    assert joined.dtype == np.float32
    assert joined.tolist() == [[np.float32(0.1), 1.0], [2.0, 0.0], [3.0, 1.0]]
    assert to_numpy(cast(yes, library.float64)).tolist() == [1.0, 0.0, 1.0]


@pytest.mark.parametrize("items", [[[], []], [[1], [2]], [None, {"a": 1}], ["ab", "cd"]])
def test_object_arrays_hold_the_objects_themselves(items: list[Any]) -> None:
    array = object_array(items)
    assert array.shape == (2,)
    assert all(held is item for held, item in zip(array, items, strict=True))


def _turn(axis: int, angle: float) -> np.ndarray:
    """Rotation about a fixed axis, written out."""
    c = math.cos(angle)
    s = math.sin(angle)
    return {
        0: np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        1: np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        2: np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


@pytest.mark.parametrize("library", [np.asarray, torch.as_tensor])
def test_euler_angles_are_turns_about_fixed_x_then_y_then_z(library: Any) -> None:
    from scipy.spatial.transform import Rotation

    half = math.pi / 2
    cases = [RNG.uniform((-3.1, -1.5, -3.1), (3.1, 1.5, 3.1)) for _ in range(200)]
    # Upside down, pointing straight down and up, and almost so.
    cases += [np.array(c) for c in ((math.pi, 0, 0.4), (-3.1, 0.2, 3.1), (0, 0, math.pi))]
    cases += [
        np.array([0.3, sign * (half - off), -0.8])
        for sign in (-1, 1)
        for off in (0, 1e-9, 1e-5)
    ]
    mats = np.stack([_turn(2, c) @ _turn(1, b) @ _turn(0, a) for a, b, c in cases])
    got = to_numpy(rot.euler_xyz(library(mats)))
    back = np.stack([_turn(2, c) @ _turn(1, b) @ _turn(0, a) for a, b, c in got])
    np.testing.assert_allclose(back, mats, atol=1e-7)
    with pytest.warns(UserWarning, match="Gimbal lock"):
        want = Rotation.from_matrix(mats).as_euler("xyz")
    apart = np.abs((got - want + math.pi) % (2 * math.pi) - math.pi)
    assert apart.max() < 1e-5
    assert (np.abs(got[:, 1]) <= half).all()
