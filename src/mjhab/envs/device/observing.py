"""Observations on the device: the rows of the observation table, computed from tensors."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mjhab.core.errors import UsageError
from mjhab.core.joints import BASE
from mjhab.envs.observations.cameras import intrinsic_matrix
from mjhab.envs.observations.entry import CameraInputs
from mjhab.envs.observations.state import state_observation
from mjhab.envs.parts.observing import ObservedRows
from mjhab.envs.parts.plan_tables import Focus
from mjhab.envs.parts.sensing import Sensing
from mjhab.sim.protocol import SimState
from mjhab.sim.warp.simulator import WarpSimulator
from mjhab.tasks.signals import Signals


class DeviceObserver(ObservedRows):
    """Computes the rows of the observation table for all worlds of a simulator on the device.

    Args:
        sim: simulator of the worlds.
        sensing: sensing of the same layout, on the device.
        mode: see `ObservedRows`.
        cameras: see `ObservedRows`.
        size: see `ObservedRows`.

    Attributes:
        renderer: the renderer; None for modes without images.
    """

    def __init__(
        self,
        sim: WarpSimulator,
        sensing: Sensing,
        mode: str,
        cameras: str | Sequence[str],
        size: int | Sequence[int],
    ) -> None:
        super().__init__(sim.layout.robot, mode, cameras, size)
        if self.target_outputs:
            raise UsageError(
                f"obs_mode {mode!r}: backend 'warp' draws no {' and '.join(self.target_outputs)}; take backend 'cpu'.",
                option="obs_mode",
                given=mode,
            )
        self._sensing = sensing
        self.renderer = None
        # The renderer takes memory for every world, which state alone does not need.
        if self.outputs:
            from mjhab.render.warp.cameras import WarpCameras

            self.renderer = WarpCameras(sim, self.cameras, self.size, self.drawn)
            matrices = [
                torch.as_tensor(intrinsic_matrix(self.robot, name, self.size))
                for name in self.cameras
            ]
            # On the device and of its dtype once, not in every step.
            self._intrinsic = torch.stack(matrices).to(sim.qpos)

    def observe(
        self,
        state: SimState,
        focus: Focus,
        signals: Signals,
        changed: torch.Tensor | None = None,
    ) -> dict[str, torch.Tensor]:
        """Compute observations (W, ...) of all worlds, which later steps do not modify.

        Args:
            state: present state.
            focus: the active subtasks.
            signals: signals measured in this state.
            changed: (W,) bool, worlds whose state has changed since the last call; None if all may have.
        """
        obs = state_observation(
            self.state_rows, self._sensing.context(state, focus, signals)
        )
        if self.renderer is None:
            return obs
        images = self.renderer.draw(changed)
        pos, mat = self.renderer.poses()
        views = CameraInputs(
            self.robot, images, pos, mat, state.robot_q[:, BASE], self._intrinsic
        )
        # Copies, because the renderer reuses its memory.
        return obs | {
            entry.key: entry.compute(views).clone() for entry in self.camera_rows
        }
