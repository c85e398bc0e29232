"""The arrays of one HDF5 trajectory of MS-HAB, as datasets of a shard."""

from __future__ import annotations

import re

import h5py
import numpy as np

from mjhab.core.conventions.changes import to_scan_axes
from mjhab.core.rotations import quat_canonical
from mjhab.data.store.hdf5 import content, dataset, dataset_paths, group
from mjhab.data.store.images import ImageFormat, encode
from mjhab.data.store.older.schemas import OBJECT_POSE

POSE = re.compile(r"pose_wrt_base$")
_CAMERAS = "sensor_data"
_PARAMETERS = "sensor_param"


def trajectory_arrays(
    trajectory: h5py.Group, turn: float
) -> tuple[dict[str, np.ndarray], dict[str, tuple[str, ...]]]:
    """Datasets of an episode by their paths in the shard schema, and the names of their columns.

    turn: yaw [rad] by which the axes of the pose of the object are turned.
    """
    actions = _rows(trajectory, "actions").astype(np.float32)
    steps = len(actions)
    parts = _state_parts(trajectory)
    if OBJECT_POSE in parts:
        # Before the parts are joined: afterwards the columns have no names.
        parts[OBJECT_POSE] = to_scan_axes(parts[OBJECT_POSE], turn)
    arrays = {
        "actions": actions,
        "subtasks/active": np.zeros(steps + 1, np.int16),
        "subtasks/step": np.zeros(1, np.int32),
        "subtasks/index": np.zeros(1, np.int16),
        "reward/total": _rows(trajectory, "rewards").astype(np.float64),
        "reward/success": _rows(trajectory, "success").astype(np.uint8),
        "reward/fail": _rows(trajectory, "fail").astype(np.uint8),
        "obs/state": np.concatenate(list(parts.values()), axis=1),
    }
    # MS-HAB executes the policy's actions without noise, so the intended actions equal the executed ones.
    recorded = {
        name: _rows(trajectory, name)
        for name in ("actions_intended", "actor")
        if name in trajectory
    }
    arrays |= {"actions_intended": actions, "actor": np.zeros(steps, np.uint8)}
    # Exports of mjhab have both, and then the recorded ones win.
    arrays |= recorded
    arrays |= _camera_arrays(trajectory)
    return arrays, {
        "obs/state": tuple(f"{key}:{part.shape[1]}" for key, part in parts.items())
    }


def _state_parts(trajectory: h5py.Group) -> dict[str, np.ndarray]:
    """Parts of the state (N+1, n) float32, in the order of the file, in which MS-HAB's scripts concatenate them.

    Quaternions have w >= 0, as in mjhab's observations.
    """
    parts: dict[str, np.ndarray] = {}
    for folder in ("agent", "extra"):
        members = group(trajectory, f"obs/{folder}")
        for name in members:
            values = _rows(members, str(name)).astype(np.float32)
            values = values.reshape(len(values), -1)
            # SAPIEN gives either sign of a quaternion, and networks would see jumps.
            if POSE.search(str(name)) and values.shape[1] == 7:
                values[:, 3:] = quat_canonical(values[:, 3:])
            parts[f"{folder}/{name}"] = values
    return parts


def _camera_arrays(trajectory: h5py.Group) -> dict[str, np.ndarray]:
    """Camera parameters unchanged, and images encoded as in shards."""
    arrays: dict[str, np.ndarray] = {}
    obs = group(trajectory, "obs")
    for path in dataset_paths(obs):
        folder, _, rest = path.partition("/")
        if folder == _PARAMETERS:
            arrays[f"obs/{path}"] = _rows(obs, path)
        if folder != _CAMERAS:
            continue
        output = rest.rpartition("/")[2]
        # Shards hold encoded images alone, so that one reader serves recorded and imported episodes.
        files = [encode(frame, output, ImageFormat()) for frame in _rows(obs, path)]
        arrays[f"images/{rest}/bytes"] = np.frombuffer(b"".join(files), np.uint8)
        arrays[f"images/{rest}/ends"] = np.cumsum(
            [len(file) for file in files], dtype=np.int64
        )
    return arrays


def trajectory_ending(trajectory: h5py.Group) -> str:
    """How an episode ended. MS-HAB's "fail" means too much force or an object that left its goal."""
    if not _rows(trajectory, "terminated")[-1]:
        return "timeout"
    return "success" if _rows(trajectory, "success")[-1] else "force_exceeded"


def _rows(parent: h5py.Group, path: str) -> np.ndarray:
    """A dataset of a trajectory (n, ...), n >= 1: one row per control step or per state.

    Raises:
        ValueError: it has no rows, or they are not numbers.
    """
    array = content(dataset(parent, path))
    # h5py also returns strings, references and compound rows from a damaged file.
    if not array.ndim or not len(array) or array.dtype.kind not in "biuf":
        raise ValueError(
            f"{path} must be rows of numbers, not {array.dtype} {array.shape}"
        )
    return array
