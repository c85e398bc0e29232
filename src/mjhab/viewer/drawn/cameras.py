"""What the robot's cameras see in the state that is shown, drawn beside the scene by the CPU rasterizer."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjhab.core.rotations import mat_from_quat
from mjhab.render.home_scene import HomeRenderer
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.viewer.drawn.posing import Pose

CAMERA_SIDE_PX = 192
CLOSE_SECONDS = 5.0


@dataclass(frozen=True, eq=False)
class _Poses:
    """The bodies of one world, as the renderer asks for them."""

    body_pos: np.ndarray
    body_mat: np.ndarray


class Cameras:
    """Draws on a thread of its own, always the newest state, and drops those in between.

    Args:
        show: called with the pictures (h, w, 3) uint8 by the name of the camera.
        side: of the pictures [px].
    """

    def __init__(
        self, show: Callable[[dict[str, np.ndarray]], object], side: int = CAMERA_SIDE_PX
    ) -> None:
        self.problem = ""
        self.drawn = 0
        self._show = show
        self._side = side
        self._sim: CpuSimulator | None = None
        self._renderer: HomeRenderer | None = None
        self._newest: tuple[CpuSimulator, str, Pose] | None = None
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="cameras", daemon=True)
        self._thread.start()

    def look(self, sim: CpuSimulator, home: str, pose: Pose) -> None:
        """Ask for the pictures of a pose in a home."""
        with self._changed:
            self._newest = (sim, home, pose)
            self._changed.notify()

    def close(self) -> None:
        """Stop drawing, after the picture in work; it is not shown."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(timeout=CLOSE_SECONDS)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._closing)
                if self._closing:
                    return
                newest = self._newest
                self._newest = None
            assert newest is not None
            try:
                drawn = self.draw(*newest)
                if self._closing:
                    return
                self._show(drawn)
                self.drawn += 1
            except Exception as error:
                self.problem = f"cameras: {type(error).__name__}: {error}"

    def draw(self, sim: CpuSimulator, home: str, pose: Pose) -> dict[str, np.ndarray]:
        """The pictures of a pose; the first call for a simulator builds its renderer."""
        if self._renderer is None or sim is not self._sim:
            # That of the environment may be drawing at the same time.
            self._renderer = HomeRenderer(sim, 1)
            self._sim = sim
        poses = _Poses(pose.pos[None], mat_from_quat(pose.quat)[None])
        views = self._renderer.robot_views(poses, [home], self._side, ("rgb",))["rgb"]
        return dict(zip(sim.layout.robot.camera_names, views[0], strict=True))
