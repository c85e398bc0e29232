"""Axes of objects and turns of joints: the conversions against scipy, on numpy and torch."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mjhab.core.conventions.changes import (
    change_axes,
    from_scan_axes,
    to_scan_axes,
    within_half_a_turn,
)
from mjhab.core.conventions.names import PUBLISHED, Conventions

YAWS = np.deg2rad([87.3, 62.4, -13.1, 1.8, 0.0])


def poses(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    quats = Rotation.random(count, rng).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    return np.concatenate([rng.normal(size=(count, 3)), quats], axis=1).astype(np.float32)


def test_a_pose_is_turned_about_its_own_z_axis_by_the_heading_of_the_scan() -> None:
    ours = poses(len(YAWS))
    turned = to_scan_axes(ours, YAWS)
    assert turned.dtype == np.float32
    np.testing.assert_array_equal(turned[:, :3], ours[:, :3])
    for pose, seen, yaw in zip(ours, turned, YAWS, strict=True):
        turn = Rotation.from_rotvec([0.0, 0.0, yaw])
        x, y, z, w = (Rotation.from_quat(pose[[4, 5, 6, 3]]) * turn).as_quat(
            canonical=True
        )
        np.testing.assert_allclose(seen[3:], (w, x, y, z), atol=1e-6)
    np.testing.assert_array_equal(turned[-1], ours[-1])
    np.testing.assert_allclose(from_scan_axes(turned, YAWS), ours, atol=1e-6)
    nothing = np.zeros((1, 7), np.float32)
    np.testing.assert_array_equal(to_scan_axes(nothing, 1.0), nothing)


def test_torch_gives_what_numpy_gives() -> None:
    ours = poses(len(YAWS))
    turned = to_scan_axes(torch.from_numpy(ours), torch.from_numpy(YAWS))
    assert turned.dtype == torch.float32
    np.testing.assert_allclose(turned.numpy(), to_scan_axes(ours, YAWS), atol=1e-7)


def test_axes_that_are_wanted_already_are_left_alone() -> None:
    ours = poses(1)
    assert change_axes(ours, 1.0, "scan", "scan") is ours
    there = change_axes(ours, 1.0, "object", "scan")
    np.testing.assert_allclose(change_axes(there, 1.0, "scan", "object"), ours, atol=1e-6)


@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 2])
def test_whole_turns_of_joints_without_limits_do_not_count(turns: int) -> None:
    q = np.array([[0.3, -3.0, 3.0, math.pi]])
    shifted = q + 2 * math.pi * turns
    for array in (shifted, torch.from_numpy(shifted)):
        every = within_half_a_turn(array, (True,) * 4)
        off = np.asarray(every) - q
        np.testing.assert_allclose(np.cos(off), 1.0, atol=1e-12)
        assert np.abs(np.asarray(every)).max() <= math.pi + 1e-9
        np.testing.assert_allclose(np.asarray(every)[:, :3], q[:, :3], atol=1e-12)
        some = np.asarray(within_half_a_turn(array, (False, True, False, False)))
        np.testing.assert_array_equal(some[:, [0, 2, 3]], shifted[:, [0, 2, 3]])
    assert within_half_a_turn(shifted, ()) is shifted


def test_what_does_not_say_its_conventions_has_those_of_older_versions() -> None:
    assert Conventions.of({"task": "set_table"}) == Conventions("object", "unwrapped")
    assert Conventions.of({"object_axes": "scan"}) == PUBLISHED
