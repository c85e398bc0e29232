"""Images of the robot's cameras in the shown state, rendered by the CPU rasterizer in a thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjhab.core.rotations import mat_from_quat
from mjhab.render.home_scene import HomeRenderer
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.viewer.drawn.posing import PosedWorld

CAMERA_SIDE_PX = 192
CLOSE_SECONDS = 5.0


@dataclass(frozen=True, eq=False)
class _Poses:
    """World poses of the bodies of one world: positions (1, B, 3) [m] and rotation matrices (1, B, 3, 3)."""

    body_pos: np.ndarray
    body_mat: np.ndarray


class CameraThread:
    """Render the newest requested state in a thread; requests that arrive while it renders replace each other.

    Args:
        show: called in that thread with the images (side, side, 3) uint8 by the name of the camera.
        side: side of the images [px].

    Attributes:
        problem: message about the last failure; "" if there is none.
        drawn: number of states rendered.
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
        self._newest: tuple[CpuSimulator, str, PosedWorld] | None = None
        self._changed = threading.Condition()
        self._closing = False
        # A thread, because drawing takes longer than a frame of the page.
        self._thread = threading.Thread(target=self._run, name="cameras", daemon=True)
        self._thread.start()

    def look(self, sim: CpuSimulator, home: str, pose: PosedWorld) -> None:
        """Request the images of a pose in a home."""
        with self._changed:
            self._newest = (sim, home, pose)
            self._changed.notify()

    def close(self) -> None:
        """Stop the thread; images that it is rendering are not shown."""
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
                # Taken: a state that comes while this one is drawn is the next.
                self._newest = None
            assert newest is not None
            try:
                drawn = self.draw(*newest)
                if self._closing:
                    return
                self._show(drawn)
                self.drawn += 1
                self.problem = ""
            # The page goes on without images, and says why.
            except Exception as error:
                self.problem = f"cameras: {type(error).__name__}: {error}"

    def draw(
        self, sim: CpuSimulator, home: str, pose: PosedWorld
    ) -> dict[str, np.ndarray]:
        """Render the images (side, side, 3) uint8 of a pose by camera name; builds a renderer for a new simulator."""
        if self._renderer is None or sim is not self._sim:
            # Not the environment's renderer, which may be in use in another thread.
            self._renderer = HomeRenderer(sim, 1)
            self._sim = sim
        poses = _Poses(pose.pos[None], mat_from_quat(pose.quat)[None])
        views = self._renderer.robot_views(poses, [home], self._side, ("rgb",))["rgb"]
        return dict(zip(sim.layout.robot.camera_names, views[0], strict=True))
