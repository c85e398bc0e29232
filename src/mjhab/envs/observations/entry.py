"""One row of the table of observations, and what rows are computed from. Letters: W worlds, C cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from mjhab.core.arrays import Array
from mjhab.robots.robot import Robot


@dataclass(frozen=True, eq=False)
class ObsContext:
    """What observations are computed from. W worlds; poses are xyz + wxyz in the frame of the base link.

    ``tcp_pose`` (W, 7) of the tool centre; ``obj_pose`` (W, 7) of the active subtask's object and ``goal_pos`` (W, 3),
    zero where the subtask has none; ``is_grasped`` (W,).
    """

    robot_q: Array
    robot_qd: Array
    tcp_pose: Array
    obj_pose: Array
    goal_pos: Array
    is_grasped: Array


@dataclass(frozen=True, eq=False)
class Views:
    """What camera rows are computed from. W worlds, C cameras asked for, in order.

    ``robot``: whose cameras they are; ``images``: "depth" (W, C, H, W) float32 [m], 0 where nothing is hit, "rgb"
    (W, C, H, W, 3) uint8, "seg" (W, C, H, W) int32; ``pos`` (W, C, 3) [m] and ``mat`` (W, C, 3, 3): cameras in the
    world, x right, y up, z backwards; ``base`` (W, 3): x, y [m], yaw [rad] of the base; ``intrinsic`` (C, 3, 3) [px].
    """

    robot: Robot
    images: Mapping[str, Array]
    pos: Array
    mat: Array
    base: Array
    intrinsic: Array


@dataclass(frozen=True)
class ObsEntry:
    """One observation. ``compute`` returns (W, *shape), from an ObsContext (state rows) or Views (camera rows)."""

    key: str
    shape: tuple[int, ...]
    unit: str
    frame: str
    compute: Callable[[Any], Array]
    meaning: str = ""
    dtype: type[np.generic] = np.float32
    low: float = -np.inf
    high: float = np.inf

    @property
    def space(self) -> spaces.Box:
        """Space of one world."""
        return spaces.Box(self.low, self.high, self.shape, self.dtype)  # type: ignore[arg-type]
