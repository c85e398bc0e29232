"""Reading of episodes of older schema versions as those of the present version."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjhab.core.conventions.changes import to_scan_axes
from mjhab.core.rotations import quat_canonical

STAND_INS: dict[str, str] = {"actions_intended": "actions", "actor": "actions"}
"""Datasets missing in schema 1, and the dataset that each is derived from."""
OBJECT_POSE = "extra/obj_pose_wrt_base"
POSES: tuple[str, ...] = ("extra/tcp_pose_wrt_base", OBJECT_POSE)
"""Observations with position and quaternion; in schema 1 the quaternion's sign is arbitrary."""
_POSE_SIZE = 7
OLDER_SCANNED = "ms_hab"
"""Profile whose observations have been in the axes of the scans since schema 3; older ones are in ours."""
OLDER_AXES = 2
"""Last schema version with poses in these axes."""
OLDER_ROBOT = "fetch"
"""Robot of shards that do not name theirs. Strings of old data: they stay when the robot's code changes."""
OLDER_JOINTS: tuple[str, ...] = (
    "torso_lift",
    "head_pan",
    "shoulder_pan",
    "head_tilt",
    "shoulder_lift",
    "upperarm_roll",
    "elbow_flex",
    "forearm_roll",
    "wrist_flex",
    "wrist_roll",
    "r_gripper_finger",
    "l_gripper_finger",
)
"""Its joints in these shards, without the base (breadth-first order, as in MS-HAB)."""


def stand_in(path: str, source: np.ndarray) -> np.ndarray:
    """Derive the missing dataset ``path`` from ``source``, the dataset ``STAND_INS[path]``."""
    return np.zeros(len(source), np.uint8) if path == "actor" else source


def canonical_poses(array: np.ndarray, columns: Mapping[str, int]) -> np.ndarray:
    """Make the quaternions in observations (N+1, D) canonical; ``columns`` has names and widths of their parts."""
    array = array.copy()
    column = 0
    for name, width in columns.items():
        if name in POSES and width == _POSE_SIZE:
            quat = slice(column + 3, column + _POSE_SIZE)
            array[:, quat] = quat_canonical(array[:, quat])
        column += width or 1
    return array


def is_turned(config: Mapping[str, Any], options: Mapping[str, Any]) -> bool:
    """Whether poses of objects are shown in the axes of the scans, although they were recorded in ours.

    Args:
        config: of the run (`RunInfo.config`).
        options: of the run; those of schema 3 tell their axes.
    """
    env = config.get("env")
    profile = env.get("profile") if isinstance(env, Mapping) else None
    # Runs since then say their axes themselves.
    return profile == OLDER_SCANNED and "object_axes" not in options


def turned_poses(
    array: np.ndarray, columns: Mapping[str, int], scan_yaw: np.ndarray
) -> np.ndarray:
    """Observations (N+1, D) with the pose of the object in the axes of its scan, for one in ours.

    Args:
        array: the observations.
        columns: names and widths of their parts.
        scan_yaw: (N+1,) headings of the scans [rad].
    """
    array = array.copy()
    column = 0
    for name, width in columns.items():
        if name == OBJECT_POSE and width == _POSE_SIZE:
            pose = slice(column, column + _POSE_SIZE)
            array[:, pose] = to_scan_axes(array[:, pose], scan_yaw)
        column += width or 1
    return array
