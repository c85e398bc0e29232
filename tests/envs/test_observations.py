"""Observations: the table and its modes, camera parameters, point clouds, segmentation."""

from __future__ import annotations

import dataclasses
import json

import mujoco
import numpy as np
import pytest
from gymnasium.vector.utils import batch_space

import mjhab.envs as envs
from mjhab.core.rotations import mat_from_quat
from mjhab.envs.observations.cameras import camera_table, intrinsic_matrix
from mjhab.envs.observations.entry import CameraInputs
from mjhab.envs.observations.modes import image_size, mode_outputs
from mjhab.envs.observations.state import state_table
from mjhab.envs.parts.observing import Observer
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.robots.fetch.model import BASE_HEIGHT
from mjhab.robots.fetch.robot import ROBOT
from mjhab.sim.protocol import SimState
from tests.refusals import refused

WORLDS = 2
OBJECT = "004_sugar_box"
HALF = np.array([0.0479, 0.0933, 0.1760]) / 2
"""Half-extents [m] of the object (YCB)."""


@pytest.fixture(scope="module")
def env() -> SequentialTaskEnv:
    env = envs.make(
        task="tidy_house",
        subtask="pick",
        num_envs=WORLDS,
        autoreset="disabled",
        threads=1,
    )
    env.reset(seed=0)
    return env


def look(
    env: SequentialTaskEnv, observer: Observer, state: SimState | None = None
) -> dict[str, np.ndarray]:
    """Observations of the environment's present state, or of a changed one."""
    assert env.signals is not None
    return observer.observe(state or env.state, env.focus, env.signals, env.homes)


def before_camera(
    env: SequentialTaskEnv, camera: str
) -> tuple[SimState, int, np.ndarray, np.ndarray]:
    """A state with one box 0.3 m ahead of a camera in every world, turned at random; its slot, positions (W, 3) and
    rotations (W, 3, 3)."""
    slot = next(
        i for i, name in enumerate(env.layout.object_names) if name.startswith(OBJECT)
    )
    body = env.sim.model(env.homes[0]).body(env.layout.object_names[slot]).id
    cam_pos, cam_mat = env.observer.renderer.camera_poses(env.state, (camera,))
    pos = cam_pos[:, 0] - 0.3 * cam_mat[:, 0, :, 2]
    quat = np.random.default_rng(3).normal(size=(WORLDS, 4))
    mat = mat_from_quat(quat / np.linalg.norm(quat, axis=1, keepdims=True))
    body_pos = env.state.body_pos.copy()
    body_mat = env.state.body_mat.copy()
    body_pos[:, body] = pos
    body_mat[:, body] = mat
    return (
        dataclasses.replace(env.state, body_pos=body_pos, body_mat=body_mat),
        slot,
        pos,
        mat,
    )


def project(
    obs: dict[str, np.ndarray], camera: str, world: int, points: np.ndarray
) -> np.ndarray:
    """(n, 3): column, row [px] and depth [m] of world points (n, 3), by the camera parameters in the observation."""
    extrinsic = obs[f"sensor_param/{camera}/extrinsic_cv"][world]
    local = points @ extrinsic[:, :3].T + extrinsic[:, 3]
    pixel = local @ obs[f"sensor_param/{camera}/intrinsic_cv"][world].T
    return np.column_stack([pixel[:, :2] / pixel[:, 2:], local[:, 2]])


def to_world(env: SequentialTaskEnv, world: int, points: np.ndarray) -> np.ndarray:
    """World points (n, 3) of points in base_link."""
    x, y, yaw = env.state.robot_q[world, :3]
    turn = np.array(
        [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
    )
    return points @ turn.T + (x, y, BASE_HEIGHT)


@pytest.mark.parametrize(
    ("mode", "cameras", "size", "images"),
    [
        ("state", ROBOT.camera_names, 128, ()),
        ("depth", ROBOT.camera_names, 16, ("depth",)),
        ("rgb", "fetch_head", 16, ("rgb",)),
        ("rgbd+seg", ("fetch_hand",), (8, 24), ("depth", "rgb", "seg")),
        ("pointcloud", ("fetch_hand", "fetch_head"), (16, 8), ()),
        ("seg+pointcloud", ROBOT.camera_names, 8, ("seg",)),
    ],
)
def test_every_mode_fills_its_space_and_describes_it(env, mode, cameras, size, images):
    observer = Observer(env.sim, env.sensing, mode, cameras, size, threads=1)
    obs = look(env, observer)
    assert batch_space(observer.single_space, WORLDS).contains(obs)
    rows = {row["key"]: row for row in json.loads(json.dumps(observer.describe()))}
    assert set(rows) == set(obs) == set(observer.single_space.spaces)
    for key, array in obs.items():
        assert (
            rows[key]["shape"] == list(array.shape[1:])
            and rows[key]["dtype"] == array.dtype.name
        )
        assert rows[key]["unit"] and rows[key]["frame"] and rows[key]["meaning"]
    names = (cameras,) if isinstance(cameras, str) else cameras
    height, width = (size, size) if isinstance(size, int) else size
    shown = {key for key in obs if key.startswith("sensor_data/")}
    assert shown == {
        f"sensor_data/{camera}/{image}" for camera in names for image in images
    }
    assert all(obs[key].shape[1:3] == (height, width) for key in shown)
    assert ("pointcloud/xyz" in obs) == ("pointcloud" in mode)
    if "pointcloud" in mode:
        assert obs["pointcloud/xyz"].shape == (WORLDS, len(names) * height * width, 3)
    assert any(key.startswith("sensor_param/") for key in obs) == (mode != "state")


def test_the_state_is_the_same_bits_in_every_mode(env):
    plain = look(env, Observer(env.sim, env.sensing))
    assert list(plain) == [entry.key for entry in state_table(ROBOT)] + ["state"]
    rich = look(env, Observer(env.sim, env.sensing, "rgbd", size=8, threads=1))
    for key, array in plain.items():
        assert array.tobytes() == rich[key].tobytes()
    np.testing.assert_array_equal(
        plain["agent/qpos"], env.state.robot_q[:, 3:].astype(np.float32)
    )


def turned(env: SequentialTaskEnv) -> SimState:
    """The present state once more: the base a full turn on, and the quaternions of the objects negated."""
    qpos = env.sim.batch.qpos.copy()
    starts = env.sim.addresses
    qpos[:, starts.robot_q[2]] += 2 * np.pi
    for start in starts.object_q:
        qpos[:, start + 3 : start + 7] *= -1.0
    env.sim.reset(range(WORLDS), env.homes, qpos)
    return env.sim.state()


def test_a_full_turn_and_the_other_quaternion_are_the_same_state(env):
    observer = Observer(env.sim, env.sensing)
    qpos = env.sim.batch.qpos.copy()
    before = look(env, observer)
    objects = env.state.object_pose.copy()
    other = turned(env)
    np.testing.assert_allclose(other.object_pose[..., 3:], -objects[..., 3:], atol=1e-12)
    after = look(env, observer, other)
    np.testing.assert_allclose(after["state"], before["state"], atol=1e-5)
    for key in ("extra/tcp_pose_wrt_base", "extra/obj_pose_wrt_base"):
        assert (before[key][:, 3] >= 0).all() and (before[key] != 0).any()
    env.sim.reset(range(WORLDS), env.homes, qpos)


def test_quaternions_of_either_sign_are_seen_as_one(env):
    """Both signs come in at w = 0 too, where a half turn about any axis lies."""
    observer = Observer(env.sim, env.sensing)
    objects = env.state.object_pose.copy()
    bodies = env.state.body_quat.copy()
    robot = env.state.robot_q.copy()
    robot[:, 2] = 0.0
    for half_turn in ([0.0, 1.0, 0.0, 0.0], [0.0, -0.6, 0.8, 0.0], [0.0, 0.0, 0.0, -1.0]):
        objects[..., 3:] = bodies[:] = half_turn
        seen = []
        for sign in (1.0, -1.0):
            signed = objects.copy()
            signed[..., 3:] *= sign
            state = dataclasses.replace(
                env.state, robot_q=robot, object_pose=signed, body_quat=sign * bodies
            )
            seen.append(look(env, observer, state)["state"])
        np.testing.assert_array_equal(*seen)


def test_physics_keeps_the_sign_of_its_quaternions(env):
    """What replay stores is the state as it is."""
    qpos = env.sim.batch.qpos.copy()
    turned(env)
    start = env.sim.addresses.object_q[0] + 3
    np.testing.assert_array_equal(
        env.sim.batch.qpos[:, start : start + 4], -qpos[:, start : start + 4]
    )
    env.sim.reset(range(WORLDS), env.homes, qpos)


def test_a_finished_plan_shows_no_object_no_goal_and_no_grasp():
    env = envs.make(task="set_table", num_envs=WORLDS, autoreset="disabled", threads=1)
    env.reset(seed=0)
    assert env.signals is not None
    length = env.tables.arrays.length
    signals = dataclasses.replace(env.signals, is_grasped=np.ones(WORLDS, bool))
    seen = []
    for pointer in (length - 2, length):
        focus = env.tables.focus(pointer)
        seen.append(env.observer.observe(env.state, focus, signals, env.homes))
    holding, finished = seen
    for key in ("extra/obj_pose_wrt_base", "extra/goal_pos_wrt_base", "extra/is_grasped"):
        assert not finished[key].any()
    assert holding["extra/is_grasped"].all() and holding["extra/goal_pos_wrt_base"].any()
    np.testing.assert_array_equal(
        finished["extra/tcp_pose_wrt_base"], holding["extra/tcp_pose_wrt_base"]
    )


def test_parts_of_modes_add_up():
    assert mode_outputs("state") == ()
    assert mode_outputs("rgbd") == ("depth", "rgb")
    assert mode_outputs("seg+rgb+rgbd") == ("depth", "rgb", "seg")
    assert mode_outputs("state+pointcloud+depth") == ("depth", "pointcloud")


def test_parts_that_are_joined_by_commas_are_told_so() -> None:
    with refused("obs_mode", "depth,rgb"):
        mode_outputs("depth,rgb")


def test_camera_poses_are_those_of_the_cameras_of_the_model(env):
    obs = look(env, Observer(env.sim, env.sensing, "depth", size=8, threads=1))
    for world in range(WORLDS):
        model = env.sim.model(env.homes[world])
        data = mujoco.MjData(model)
        data.qpos[:] = env.sim.batch.qpos[world]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        for camera in ROBOT.camera_names:
            pose = obs[f"sensor_param/{camera}/cam2world_gl"][world]
            np.testing.assert_allclose(pose[:3, 3], data.cam(camera).xpos, atol=1e-5)
            np.testing.assert_allclose(
                pose[:3, :3], data.cam(camera).xmat.reshape(3, 3), atol=1e-5
            )
            # extrinsic_cv is its inverse with y and z turned round.
            there = np.vstack(
                [obs[f"sensor_param/{camera}/extrinsic_cv"][world], [0, 0, 0, 1]]
            )
            np.testing.assert_allclose(there @ pose, np.diag([1, -1, -1, 1]), atol=1e-5)


def test_intrinsics_come_from_the_vertical_field_of_view():
    matrix = intrinsic_matrix(ROBOT, "fetch_head", (64, 96))
    # 2 rad from the lowest to the highest row (mshab: fov of both Fetch cameras).
    assert 2 * np.arctan(32 / matrix[1, 1]) == pytest.approx(2.0)
    np.testing.assert_allclose(
        matrix, [[matrix[1, 1], 0, 48], [0, matrix[1, 1], 32], [0, 0, 1]]
    )


@pytest.mark.parametrize("camera", ROBOT.camera_names)
def test_points_of_an_object_project_onto_its_segment_at_its_depth(env, camera):
    observer = Observer(env.sim, env.sensing, "depth+seg", camera, (96, 160), threads=1)
    state, slot, pos, mat = before_camera(env, camera)
    obs = look(env, observer, state)
    corners = (
        0.7
        * HALF
        * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    )
    seg_id = observer.segmentation_names.index(env.layout.object_names[slot])
    for world in range(WORLDS):
        col, row, depth = project(
            obs, camera, world, corners @ mat[world].T + pos[world]
        ).T
        at = (np.floor(row).astype(int), np.floor(col).astype(int))
        assert (obs[f"sensor_data/{camera}/seg"][world][at] == seg_id).all()
        # The surface lies before points inside, by less than the object's size.
        ahead = depth - obs[f"sensor_data/{camera}/depth"][world][at][:, 0] / 1000
        assert (ahead > 0).all() and (ahead < 2 * np.linalg.norm(HALF)).all()


def test_the_cloud_lies_on_the_depth_images_and_on_the_object(env):
    cameras = ("fetch_hand", "fetch_head")
    size = (48, 64)
    observer = Observer(
        env.sim, env.sensing, "rgbd+seg+pointcloud", cameras, size, threads=1
    )
    state, slot, pos, mat = before_camera(env, "fetch_head")
    obs = look(env, observer, state)
    seg_id = observer.segmentation_names.index(env.layout.object_names[slot])
    for world in range(WORLDS):
        xyz = to_world(env, world, obs["pointcloud/xyz"][world].astype(float))
        seg = obs["pointcloud/seg"][world, :, 0]
        for k, camera in enumerate(cameras):
            part = slice(k * size[0] * size[1], (k + 1) * size[0] * size[1])
            for name in ("rgb", "seg"):
                image = obs[f"sensor_data/{camera}/{name}"][world]
                np.testing.assert_array_equal(
                    obs[f"pointcloud/{name}"][world, part],
                    image.reshape(-1, image.shape[2]),
                )
            mm = obs[f"sensor_data/{camera}/depth"][world].reshape(-1)
            hit = mm > 0
            np.testing.assert_array_equal(hit, seg[part] > 0)
            assert not obs["pointcloud/xyz"][world, part][~hit].any()
            pixel = project(obs, camera, world, xyz[part])[hit]
            row, col = np.divmod(np.flatnonzero(hit), size[1])
            np.testing.assert_allclose(
                pixel[:, :2], np.column_stack([col, row]) + 0.5, atol=0.01
            )
            np.testing.assert_allclose(pixel[:, 2], mm[hit] / 1000, atol=0.00055)
        local = (xyz[seg == seg_id] - pos[world]) @ mat[world]
        assert len(local) > 20
        # Distance to the surface of the box from inside or outside; labels stand 0.5 mm proud of it.
        assert np.abs((np.abs(local) - HALF).max(axis=1)).max() < 0.001


def test_one_camera_sees_what_it_sees_beside_another(env):
    both = look(env, Observer(env.sim, env.sensing, "rgbd+seg", size=32, threads=1))
    hand = look(
        env, Observer(env.sim, env.sensing, "rgbd+seg", "fetch_hand", 32, threads=1)
    )
    assert not any("fetch_head" in key for key in hand)
    for key, array in hand.items():
        np.testing.assert_array_equal(array, both[key])


def test_a_wider_image_shows_more_at_the_sides_and_the_same_in_the_middle(env):
    square = look(
        env, Observer(env.sim, env.sensing, "depth", "fetch_head", 32, threads=1)
    )
    wide = look(
        env, Observer(env.sim, env.sensing, "depth", "fetch_head", (32, 64), threads=1)
    )
    key = "sensor_data/fetch_head/depth"
    apart = np.abs(wide[key][:, :, 16:48].astype(int) - square[key])
    assert (apart <= 1).mean() > 0.995  # pixels right on an edge may fall to either side


def synthetic(depth: np.ndarray, base: tuple[float, float, float]) -> CameraInputs:
    """One world, a camera at (1, 2, 1.5) that looks along +y with z up, 4 columns and 2 rows, focal length 2 px."""
    mat = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    intrinsic = np.array([[2.0, 0, 2], [0, 2, 1], [0, 0, 1]])
    images = {"depth": depth.astype(np.float32)[None, None]}
    return CameraInputs(
        ROBOT,
        images,
        np.array([[[1.0, 2.0, 1.5]]]),
        mat[None, None],
        np.array([base]),
        intrinsic[None],
    )


def row_of(key: str):
    table = camera_table(ROBOT, ("depth", "pointcloud"), ("fetch_head",), (2, 4))
    return next(entry for entry in table if entry.key == key)


def test_cloud_of_a_camera_by_hand():
    depth = np.array([[2.0, 2.0, 2.0, 0.0], [4.0, 4.0, 4.0, 4.0]])
    # The base stands at (1, 2) and faces +y: base x is world y, base y is world -x.
    xyz = row_of("pointcloud/xyz").compute(synthetic(depth, (1.0, 2.0, np.pi / 2)))
    up = 1.5 - BASE_HEIGHT
    # Column 0 lies 1.5 px left of the axis: 1.5 / 2 * depth; rows half a pixel above and below it.
    want = [(2, 1.5, up + 0.5), (2, 0.5, up + 0.5), (2, -0.5, up + 0.5), (0, 0, 0)]
    want += [(4, 3, up - 1), (4, 1, up - 1), (4, -1, up - 1), (4, -3, up - 1)]
    np.testing.assert_allclose(xyz[0], want, atol=1e-6)


def test_depth_is_rounded_to_millimetres_and_capped():
    depth = np.array([[1.2344, 1.2346, 0.0, 40.0], [0.0104, 32.767, 32.768, 5.0]])
    image = row_of("sensor_data/fetch_head/depth").compute(
        synthetic(depth, (0.0, 0.0, 0.0))
    )
    assert image.dtype == np.int16 and image.shape == (1, 2, 4, 1)
    assert image[0, ..., 0].tolist() == [[1234, 1235, 0, 32767], [10, 32767, 32767, 5000]]


@pytest.mark.parametrize("value", [np.nan, 1e30])
def test_a_world_that_diverged_is_blank_and_leaves_the_others(env, value):
    observer = Observer(env.sim, env.sensing, "rgbd+seg", size=16, threads=1)
    body_pos = env.state.body_pos.copy()
    body_mat = env.state.body_mat.copy()
    body_pos[0, 5:] = value
    if np.isnan(value):
        body_mat[0] = value
    bad = look(
        env,
        observer,
        dataclasses.replace(env.state, body_pos=body_pos, body_mat=body_mat),
    )
    good = look(env, observer)
    for key in (key for key in good if key.startswith("sensor_data/")):
        assert not bad[key][0].any() and good[key][0].any()
        np.testing.assert_array_equal(bad[key][1], good[key][1])
    everywhere = dataclasses.replace(env.state, body_pos=np.full_like(body_pos, value))
    assert not look(env, observer, everywhere)["sensor_data/fetch_head/depth"].any()


def test_segmentation_names_are_those_of_the_layout(env):
    observer = Observer(env.sim, env.sensing, "seg", size=48, threads=1)
    names = observer.segmentation_names
    assert names[0] == "background" and len(set(names)) == len(names)
    assert set(env.layout.object_names) <= set(names)
    obs = look(env, observer)
    for world in range(WORLDS):
        head = {names[i] for i in np.unique(obs["sensor_data/fetch_head/seg"][world])}
        hand = {names[i] for i in np.unique(obs["sensor_data/fetch_hand/seg"][world])}
        assert {"floor", "wall"} & head
        assert {"robot/r_gripper_finger_link", "robot/l_gripper_finger_link"} <= hand


def test_wrong_names_and_sizes_are_refused(env):
    with refused("observation mode", "dept", expected="depth"):
        Observer(env.sim, env.sensing, "rgb+dept")
    with refused("observation mode", ""):
        Observer(env.sim, env.sensing, "")
    with refused("camera", "fetch_haed", expected="fetch_head"):
        Observer(env.sim, env.sensing, "rgb", ("fetch_haed",))
    with refused("cameras", expected="at least one"):
        Observer(env.sim, env.sensing, "rgb", ())
    for size in (7, (8, 7), (16,), 16.0, "ab", (8, 8, 3), 10**6):
        with refused("camera size", size, expected="each 8 to 4096"):
            image_size(size)  # type: ignore[arg-type]
    with refused("camera", "top"):
        env.observer.renderer.robot_views(env.state, env.homes, 16, ("rgb",), ("top",))
