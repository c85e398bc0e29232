"""Views of a target: depth relative to its distance, and nothing that the robot's camera does not see."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mjhab
from mjhab.envs.observations.cameras import intrinsic_matrix
from mjhab.render.target_views import (
    FOV,
    MIDDLE,
    RANGE_SHARE,
    UNSEEN,
    rays,
    relative_bytes,
    target_views,
    turned,
)
from mjhab.robots.registry import robot_named
from tests.refusals import refused

HEAD = ("fetch_head",)
SIZE = (32, 32)


@pytest.fixture(scope="module")
def env() -> Any:
    made = mjhab.make(
        task="set_table",
        subtask="open",
        target="kitchen_counter/drawer3",
        home="builtin_m0_00",
        obs_mode="target_depth",
        camera_size=32,
        num_envs=2,
        threads=1,
    )
    made.reset(seed=0)
    yield made
    made.close()


def test_bytes_tell_depth_relative_to_the_distance() -> None:
    distance = np.array([0.4, 2.0])
    shares = np.array([1.0, 0.75, 1.25, 0.5, 9.0, 0.0, 1.0 + RANGE_SHARE / 127])
    depth = (distance[:, None] * shares)[:, None, :]
    told = relative_bytes(depth, distance)
    assert told.tolist() == [[[MIDDLE, 255, 1, 255, 1, UNSEEN, MIDDLE - 1]]] * 2


def test_a_turned_camera_looks_at_the_target_and_keeps_its_vertical() -> None:
    random = np.random.default_rng(0)
    pos, target = random.normal(size=(2, 50, 3))
    own = np.linalg.qr(random.normal(size=(50, 3, 3)))[0]
    own[:, :, 0] *= np.linalg.det(own)[:, None]
    mat, distance = turned(pos, own, target)
    seen = np.einsum("nji,nj->ni", mat, target - pos)
    np.testing.assert_allclose(seen, distance[:, None] * [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(mat), 1.0)
    # Its x axis is level in the robot's image, its y axis upwards.
    assert np.abs(np.einsum("ni,ni->n", mat[:, :, 0], own[:, :, 1])).max() < 1e-12
    assert np.einsum("ni,ni->n", mat[:, :, 1], own[:, :, 1]).min() > 0


def views_at(env: Any, direction: list[float], length: float = 1.5) -> np.ndarray:
    """Views (W, 32, 32) of a target in a direction of the frame of the head's camera."""
    pos, mat = env.observer.renderer.camera_poses(env.state, HEAD)
    target = pos[:, 0] + length * mat[:, 0] @ np.array(direction)
    looking = (env.observer.renderer, env.state, env.homes, target, SIZE, HEAD)
    views = target_views(*looking)["target_depth"]
    assert views.shape == (2, 1, *SIZE) and views.dtype == np.uint8
    return views[:, 0]


def test_what_the_camera_does_not_see_stays_empty(env: Any) -> None:
    half = np.tan(robot_named().camera(HEAD[0]).fovy / 2)
    assert (views_at(env, [0.0, 0.0, -1.0]) > UNSEEN).all()
    for unseen in ([0.0, 0.0, 1.0], [0.0, 1.01 * half, -1.0], [-1.01 * half, 0.0, -1.0]):
        assert not views_at(env, unseen).any()
    assert not views_at(env, [0.0, 0.0, -1.0], length=0.01).any()
    # A target at the right edge: the right half of the view lies outside of the camera's image.
    edge = views_at(env, [0.999 * half, 0.0, -1.0])
    assert (edge[:, :, :15] > UNSEEN).all() and not edge[:, :, 17:].any()


def test_a_view_shows_what_a_large_image_shows_there(env: Any) -> None:
    """Points of the view, from its bytes, lie on the surfaces of the camera's own depth image."""
    renderer = env.observer.renderer
    side = 512
    whole = renderer.robot_views(env.state, env.homes, side, ("depth",), HEAD)["depth"]
    pos, mat = renderer.camera_poses(env.state, HEAD)
    direction = np.array([0.1, -0.2, -1.0])
    length = 1.5
    views = views_at(env, direction.tolist(), length)
    target = pos[:, 0] + length * mat[:, 0] @ direction
    look, distance = turned(pos[:, 0], mat[:, 0], target)
    depth = distance[:, None, None] * (
        1.0 - RANGE_SHARE * (views.astype(float) - MIDDLE) / 127
    )
    world = np.einsum("nij,hwj->nhwi", look, rays(SIZE)) * depth[..., None]
    own = np.einsum("nji,nhwj->nhwi", mat[:, 0], world)
    focal = intrinsic_matrix(robot_named(), HEAD[0], (side, side))[0, 0]
    column = np.floor(side / 2 - focal * own[..., 0] / own[..., 2]).astype(int)
    row = np.floor(side / 2 + focal * own[..., 1] / own[..., 2]).astype(int)
    told = (views > 1) & (views < 255)
    assert told.mean() > 0.1
    for world_number in range(2):
        chosen = told[world_number]
        there = whole[world_number, 0, row[world_number], column[world_number]]
        off = np.abs(there + own[world_number, ..., 2])[chosen]
        # A byte is 3 mm here; edges of surfaces fall on the one or the other side.
        assert np.mean(off < 0.01) > 0.85


def test_observations_look_at_the_handle(env: Any) -> None:
    obs, _ = env.reset(seed=3)
    shown = [obs[f"sensor_data/{camera}/target_depth"] for camera in env.observer.cameras]
    assert all(image.shape == (2, *SIZE, 1) for image in shown)
    # Whichever camera sees the handle, the middle of its view is about at the handle's distance.
    middles = np.stack(shown)[:, :, 14:18, 14:18, 0]
    seen = middles[(middles > UNSEEN).all((2, 3))]
    assert len(seen) and np.abs(np.median(seen) - MIDDLE) < 40
    assert robot_named().camera(HEAD[0]).fovy > FOV


def test_modes_that_hide_the_target_and_backend_warp_are_refused() -> None:
    with refused("obs_mode", said="proprioception"):
        mjhab.make(subtask="pick", obs_mode="proprioception+target_depth").reset()
    from mjhab.envs.device.observing import DeviceObserver

    layout = SimpleNamespace(robot=robot_named())
    sim: Any = SimpleNamespace(layout=layout)
    with refused("obs_mode", "target_depth", said="cpu"):
        DeviceObserver(sim, None, "target_depth", HEAD, 32)  # type: ignore[arg-type]
