"""Files of spawns and grasps, as ``torch.save`` writes them: ``spawn_data.pt`` and ``grasp_poses.pt``.

Spawn data map the ``uid`` of a subtask to arrays with a row per spawn. The robot stands where ``robot_pos`` and the
first two joints add up to. Objects are in the axes of their scans. Written numbers are float32, as in the original.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mjhab.core.errors import fault, wrong_value
from mjhab.core.files.cache import write_atomic
from mjhab.data.imports.torch_files import read_torch

ROBOT_POS = "robot_pos"
ROBOT_QPOS = "robot_qpos"
ARTICULATION_QPOS = "articulation_qpos"
OBJ_POSE = "obj_raw_pose"
HELD_POSE = "obj_raw_pose_wrt_tcp"
PLACED_POSE = "placed_obj_raw_pose"
"""Not of the original, which reads over it: where the object of ``remove_obj_id`` is instead of out of the home."""

Spawns = Mapping[str, np.ndarray]
"""Arrays (n, k) by name: robot_pos (n, 3) [m], robot_qpos (n, 15) [m, rad], poses (n, 7) [m, wxyz], articulation_qpos
(n, joints of the piece of furniture) [m or rad], or (n, 1) where none is opened."""

JOINTS = 15
_WIDTHS = {
    ROBOT_POS: 3,
    ROBOT_QPOS: JOINTS,
    OBJ_POSE: 7,
    HELD_POSE: 7,
    PLACED_POSE: 7,
    ARTICULATION_QPOS: None,
}
"""Columns by name; None for any number."""
_NEEDED = (ROBOT_POS, ROBOT_QPOS)
_GRASPS = {"success_qpos": JOINTS, "success_obj_raw_pose_wrt_tcp": 7}
_REMEDY = "Save tensors alone: torch.save({uid: {'robot_pos': tensor, ...}}, path)."


def read_spawn_data(path: Path) -> dict[str, Spawns]:
    """Read the spawns of every subtask, by its ``uid``.

    Raises:
        UsageError: there is no such file, it needs more than tensors, or has another layout; the message names file,
            subtask and array.
    """
    content = read_torch(path, "spawn data, spawn_data.pt of MS-HAB", _REMEDY)
    layout = "a mapping of subtask uid to robot_pos, robot_qpos and the like"
    if not isinstance(content, Mapping) or not content:
        raise wrong_value("spawn data", type(content).__name__, layout, where=path)
    found = {}
    for uid, entry in content.items():
        if not isinstance(uid, str) or not isinstance(entry, Mapping):
            raise wrong_value("spawn data", uid, layout, where=path)
        arrays = {
            str(name): _array(path, f"{uid}.{name}", value, _WIDTHS[name])
            for name, value in entry.items()
            if name in _WIDTHS
        }
        lacking = [name for name in _NEEDED if name not in arrays]
        if lacking:
            held = ", ".join(map(str, entry)) or "nothing"
            raise fault(
                path, f"{uid} has no {' and no '.join(lacking)}; it holds {held}."
            )
        counts = {name: len(array) for name, array in arrays.items()}
        if len(set(counts.values())) > 1 or not counts[ROBOT_POS]:
            raise fault(
                path, f"{uid} has arrays of different numbers of spawns: {counts}."
            )
        found[uid] = arrays
    return found


def write_spawn_data(path: Path, spawns: Mapping[str, Spawns]) -> None:
    """Write spawns by the ``uid`` of their subtasks, atomically; inverse of `read_spawn_data` up to float32."""
    _save(path, {uid: _tensors(entry) for uid, entry in spawns.items()})


def read_grasp_poses(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the robot's joints (N, 15) [m, rad] and the pose of the object in its tool (N, 7) [m, wxyz] of N grasps.

    Raises:
        UsageError: there is no such file, it needs more than tensors, or has another layout.
    """
    content = read_torch(path, "grasps, grasp_poses.pt of MS-HAB", _REMEDY)
    if not isinstance(content, Mapping) or not set(_GRASPS) <= set(content):
        raise wrong_value(
            "grasps", type(content).__name__, f"a mapping with {' and '.join(_GRASPS)}"
        )
    joints, poses = (
        _array(path, name, content[name], width) for name, width in _GRASPS.items()
    )
    if len(joints) != len(poses):
        raise fault(path, f"it has {len(joints)} postures and {len(poses)} poses.")
    return joints, poses


def write_grasp_poses(path: Path, joints: np.ndarray, poses: np.ndarray) -> None:
    """Write grasps, atomically; inverse of `read_grasp_poses` up to float32."""
    _save(path, _tensors(dict(zip(_GRASPS, (joints, poses), strict=True))))


def _array(path: Path, name: str, value: object, width: int | None) -> np.ndarray:
    """A tensor of the file as float64.

    Raises:
        UsageError: it is none, has another shape, or numbers that are not finite.
    """
    import torch

    if not isinstance(value, torch.Tensor):
        raise wrong_value(name, type(value).__name__, "a tensor", where=path)
    shape = tuple(value.shape)
    if len(shape) != 2 or not shape[1] or (width is not None and shape[1] != width):
        raise wrong_value(
            f"shape of {name}",
            shape,
            f"(spawns, {'joints' if width is None else width})",
            "Spawns of MS-HAB are of the robot Fetch." if width == JOINTS else "",
            where=path,
        )
    array = value.detach().to(torch.float64).numpy()
    if not np.isfinite(array).all():
        raise fault(path, f"{name} has numbers that are not finite.")
    return array


def _tensors(arrays: Spawns) -> dict[str, object]:
    import torch

    return {
        name: torch.tensor(np.asarray(array), dtype=torch.float32)
        for name, array in arrays.items()
    }


def _save(path: Path, content: object) -> None:
    import torch

    write_atomic(path, lambda temporary: torch.save(content, temporary))
