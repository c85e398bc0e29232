"""Observations on the device: the rows of the observation table, computed from tensors."""

from __future__ import annotations

import torch

from mjhab.core.joints import BASE
from mjhab.envs.observations import (
    CAMERA_OUTPUTS,
    POINTCLOUD,
    Views,
    intrinsic_matrix,
    state_observation,
    state_table,
)
from mjhab.envs.parts.observing import Observer
from mjhab.envs.parts.plan_tables import Focus
from mjhab.envs.parts.sensing import Sensing
from mjhab.sim.protocol import SimState
from mjhab.sim.warp.simulator import WarpSimulator
from mjhab.tasks.measure import Signals


class DeviceObserver:
    """Computes the rows of ``host``'s observation table for all worlds of a simulator on the device.

    Args:
        sim: worlds to look into.
        sensing: of the same layout, on the device.
        host: knows mode, cameras and size; it draws nothing.

    ``cameras``: what draws, None without pictures.
    """

    def __init__(self, sim: WarpSimulator, sensing: Sensing, host: Observer) -> None:
        self._sensing = sensing
        robot = sim.layout.robot
        self._robot = robot
        self._rows = host.table[len(state_table(robot)) :]
        self.cameras = None
        if host.outputs:
            from mjhab.render.warp.cameras import WarpCameras

            drawn = CAMERA_OUTPUTS if POINTCLOUD in host.outputs else host.outputs
            self.cameras = WarpCameras(sim, host.cameras, host.size, drawn)
            matrices = [
                torch.as_tensor(intrinsic_matrix(robot, name, host.size)) for name in host.cameras
            ]
            self._intrinsic = torch.stack(matrices).to(sim.qpos)

    def observe(
        self, state: SimState, focus: Focus, signals: Signals, changed: torch.Tensor | None = None
    ) -> dict[str, torch.Tensor]:
        """Observations (W, ...) of all worlds, which later steps do not change.

        Args:
            state, focus, signals: of the present.
            changed: (W,) bool, worlds whose state is another than in the last call; None where all may have moved.
        """
        obs = state_observation(self._robot, self._sensing.context(state, focus, signals))
        if self.cameras is None:
            return obs
        images = self.cameras.draw(changed)
        pos, mat = self.cameras.poses()
        views = Views(self._robot, images, pos, mat, state.robot_q[:, BASE], self._intrinsic)
        # The renderer draws into the same memory again.
        return obs | {entry.key: entry.compute(views).clone() for entry in self._rows}
