"""One row of the observation table, and the inputs of rows. Letters: W worlds, J joints, C cameras."""

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
    """Inputs of state rows. Poses are xyz [m] + wxyz in the frame of the base link.

    Attributes:
        robot_q: (W, J) joint positions, within half a turn where the conventions wrap them.
        robot_qd: (W, J) joint velocities.
        tcp_pose: (W, 7) pose of the tcp.
        obj_pose: (W, 7) pose of the active subtask's object in the axes of the conventions, zero if it has none.
        goal_pos: (W, 3) goal of the active subtask, zero if it has none.
        is_grasped: (W,) bool, the target of the active subtask is grasped.
    """

    robot_q: Array
    robot_qd: Array
    tcp_pose: Array
    obj_pose: Array
    goal_pos: Array
    is_grasped: Array


@dataclass(frozen=True, eq=False)
class CameraInputs:
    """Inputs of camera rows, for C cameras in the order asked for and images of height h and width w.

    Attributes:
        robot: the robot with the cameras.
        images: "depth" (W, C, h, w) float32 [m], 0 where nothing is hit; "rgb" (W, C, h, w, 3) uint8; "seg"
            (W, C, h, w) int32; "target_depth" (W, C, h, w) and "target_rgb" (W, C, h, w, 3) uint8.
        pos: (W, C, 3) positions of the cameras in the world [m].
        mat: (W, C, 3, 3) rotations of the cameras in the world, with x right, y up, z backwards.
        base: (W, 3) x, y [m], yaw [rad] of the base in the world.
        intrinsic: (C, 3, 3) pinhole matrices [px].
    """

    robot: Robot
    images: Mapping[str, Array]
    pos: Array
    mat: Array
    base: Array
    intrinsic: Array


@dataclass(frozen=True)
class ObsEntry:
    """One row of the observation table.

    Attributes:
        key: key of the observation.
        shape: shape for one world.
        unit: unit, for people.
        frame: coordinate frame, for people.
        compute: function from an `ObsContext` (state rows) or `CameraInputs` (camera rows) to an array (W, *shape).
        meaning: description, for people.
        dtype: type of the entries.
        low: least value.
        high: greatest value.
    """

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
