"""The handle of the hand: what a person drags in the page so that the gripper follows."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from mjhab.core.rotations import pose_inv, pose_mul

LENGTH = 0.22
"""Length of its arrows [m]."""
DRAG_SECONDS = 2.0
"""How long a drag of which nothing more is heard keeps the server from moving the handle [s]."""
_MIN_MOVE = 1e-4
_ORIGIN = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


class PoseHandle:
    """Arrows and arcs at the pose that the gripper goes to.

    Args:
        scene: of the server.
        on_drag: called with the pose (7,) that it is dragged to, in the frame of `Robot.arm_root`.
    """

    def __init__(
        self, scene: viser.SceneApi, on_drag: Callable[[np.ndarray], object]
    ) -> None:
        self._gizmo = scene.add_transform_controls(
            "/marks/hand", scale=LENGTH, depth_test=False, opacity=0.8, visible=False
        )
        self._gizmo.on_update(self._dragged)
        self._on_drag = on_drag
        self._root = _ORIGIN
        self._dragged_at = -np.inf

    async def _dragged(self, event: Any) -> None:
        """Tell where the page has dragged it; on the thread of viser, because callbacks of others lose the order."""
        self._dragged_at = -np.inf if event.phase == "end" else time.monotonic()
        if not self._gizmo.visible:
            return
        pose = np.concatenate([self._gizmo.position, self._gizmo.wxyz])
        self._on_drag(pose_mul(pose_inv(self._root), pose))

    def show(self, root: np.ndarray, pose: np.ndarray | None) -> None:
        """Move it, unless it is being dragged.

        Args:
            root: pose (7,) of `Robot.arm_root` in the world.
            pose: pose (7,) that the gripper goes to in that frame; None hides the handle.
        """
        self._root = root
        if self._gizmo.visible != (pose is not None):
            self._gizmo.visible = pose is not None
        # Moved by both, it would jump under the mouse.
        if pose is None or time.monotonic() - self._dragged_at < DRAG_SECONDS:
            return
        wanted = pose_mul(root, pose)
        now = np.concatenate([self._gizmo.position, self._gizmo.wxyz])
        # Each assignment is a message to all pages.
        if np.abs(wanted - now).max() > _MIN_MOVE:
            self._gizmo.position = wanted[:3]
            self._gizmo.wxyz = wanted[3:]
