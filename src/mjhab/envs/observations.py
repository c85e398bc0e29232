"""One table of observations: key, shape, unit, frame, function (mshab/envs/sequential_task.py).

The concatenation of the six state entries is the 42-D ``state``. Entries that the active subtask does not use are zero,
so that one policy interface serves all subtasks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces

from mjhab.scenes.fetch import BASE_HEIGHT


@dataclass(frozen=True, eq=False)
class ObsContext:
    """What observations are computed from. W worlds; poses are xyz + wxyz in the frame of base_link.

    ``tcp_pose`` (W, 7) of gripper_link; ``obj_pose`` (W, 7) of the active subtask's object and ``goal_pos`` (W, 3),
    zero where the subtask has none; ``is_grasped`` (W,).
    """

    robot_q: np.ndarray
    robot_qd: np.ndarray
    tcp_pose: np.ndarray
    obj_pose: np.ndarray
    goal_pos: np.ndarray
    is_grasped: np.ndarray


def pose_in_base(base: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """World poses (..., W, 7) in the frame of base_link. ``base`` (W, 3): x, y, yaw."""
    # The base turns about z only: half of the quaternion product is zero and left out.
    yaw = base[:, 2]
    c, s = np.cos(yaw), np.sin(yaw)
    ch, sh = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
    x, y = pose[..., 0] - base[:, 0], pose[..., 1] - base[:, 1]
    qw, qx, qy, qz = pose[..., 3], pose[..., 4], pose[..., 5], pose[..., 6]
    out = np.empty(pose.shape)
    out[..., 0] = c * x + s * y
    out[..., 1] = c * y - s * x
    out[..., 2] = pose[..., 2] - BASE_HEIGHT
    out[..., 3] = ch * qw + sh * qz
    out[..., 4] = ch * qx + sh * qy
    out[..., 5] = ch * qy - sh * qx
    out[..., 6] = ch * qz - sh * qw
    return out


@dataclass(frozen=True)
class ObsEntry:
    """One observation. ``compute`` returns (W, *shape)."""

    key: str
    shape: tuple[int, ...]
    unit: str
    frame: str
    compute: Callable[[ObsContext], np.ndarray]


STATE_TABLE = (
    ObsEntry("agent/qpos", (12,), "m, rad", "joint: torso, head, arm, fingers", lambda c: c.robot_q[:, 3:]),
    ObsEntry("agent/qvel", (12,), "m/s, rad/s", "joint: torso, head, arm, fingers", lambda c: c.robot_qd[:, 3:]),
    ObsEntry("extra/tcp_pose_wrt_base", (7,), "m, wxyz", "base_link", lambda c: c.tcp_pose),
    ObsEntry("extra/obj_pose_wrt_base", (7,), "m, wxyz", "base_link", lambda c: c.obj_pose),
    ObsEntry("extra/goal_pos_wrt_base", (3,), "m", "base_link", lambda c: c.goal_pos),
    ObsEntry("extra/is_grasped", (1,), "0 or 1", "-", lambda c: c.is_grasped[:, None]),
)
STATE_DIM = sum(entry.shape[0] for entry in STATE_TABLE)
STATE_KEY = "state"
CAMERA_KEYS = ("fetch_head", "fetch_hand")
CAMERA_OUTPUTS = ("depth", "rgb", "seg")
DEPTH_SCALE = 1000.0
"""Depth images are int16 millimetres, 0 where nothing is hit."""


def camera_key(camera: str, output: str) -> str:
    """Key of one camera image in the observation."""
    return f"sensor_data/{camera}/{output}"


def single_space(cameras: tuple[str, ...] = (), size: int = 128) -> spaces.Dict:
    """Observation space of one world, with images of ``cameras`` (outputs of CAMERA_OUTPUTS) at ``size``."""
    box: dict[str, spaces.Space] = {e.key: spaces.Box(-np.inf, np.inf, e.shape, np.float32) for e in STATE_TABLE}
    box[STATE_KEY] = spaces.Box(-np.inf, np.inf, (STATE_DIM,), np.float32)
    for name in CAMERA_KEYS if cameras else ():
        for output in cameras:
            if output == "rgb":
                box[camera_key(name, output)] = spaces.Box(0, 255, (size, size, 3), np.uint8)
            else:
                kind = np.int16 if output == "depth" else np.int32
                box[camera_key(name, output)] = spaces.Box(0, np.iinfo(kind).max, (size, size, 1), kind)
    return spaces.Dict(box)


def state_observation(context: ObsContext) -> dict[str, np.ndarray]:
    """Every entry of STATE_TABLE and their concatenation, float32, (W, ...); the entries are views of it."""
    state = np.empty((len(context.robot_q), STATE_DIM), np.float32)
    np.concatenate([entry.compute(context) for entry in STATE_TABLE], axis=1, out=state)
    obs, column = {}, 0
    for entry in STATE_TABLE:
        obs[entry.key] = state[:, column : column + entry.shape[0]]
        column += entry.shape[0]
    obs[STATE_KEY] = state
    return obs


def image_observation(camera: str, output: str, image: np.ndarray) -> np.ndarray:
    """Turn a rendered image (W, H, W[, 3]) into its observation: depth [m] to int16 mm, a channel axis for seg."""
    if output == "rgb":
        return image
    if output == "depth":
        return np.minimum(np.rint(image * DEPTH_SCALE), np.iinfo(np.int16).max).astype(np.int16)[..., None]
    return image.astype(np.int32)[..., None]
