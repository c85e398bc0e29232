"""How episodes of an older schema are read as those of the present one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mjhab.core.rotations import quat_canonical

STAND_INS: dict[str, str] = {"actions_intended": "actions", "actor": "actions"}
"""Dataset that schema 1 does not have to the one that it is made of."""
POSES: tuple[str, ...] = ("extra/tcp_pose_wrt_base", "extra/obj_pose_wrt_base")
"""Observations of x, y, z and a quaternion, whose sign is any in schema 1."""
_POSE_SIZE = 7


def stand_in(path: str, source: np.ndarray) -> np.ndarray:
    """The dataset at ``path`` of an episode without it, from ``STAND_INS[path]``: all by one actor, as intended."""
    return np.zeros(len(source), np.uint8) if path == "actor" else source


def canonical_poses(array: np.ndarray, columns: Mapping[str, int]) -> np.ndarray:
    """Observations (N+1, D) of schema 1 with canonical quaternions; ``columns``: names and widths of their parts."""
    array = array.copy()
    column = 0
    for name, width in columns.items():
        if name in POSES and width == _POSE_SIZE:
            quat = slice(column + 3, column + _POSE_SIZE)
            array[:, quat] = quat_canonical(array[:, quat])
        column += width or 1
    return array
