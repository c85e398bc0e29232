"""Observations for agents: tensors on the device of their networks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from mjhab.learning.observation.encoder import ObservationEncoder
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.tasks.subtasks.registry import horizons

if TYPE_CHECKING:
    from mjhab.envs.parts.worlds import PolicyWorlds

PRIVILEGED = (
    "position and velocity of every joint of the robot, the base among them",
    "position and velocity of every joint of the furniture",
    "time that remains, as a fraction of the horizon",
    "norm of the forces on the robot [kN], and their sum over the steps so far [5,000 N x steps]",
    "the checks of the active subtask, 0 or 1",
)
"""Inputs that a privileged critic receives in addition to the actor's, in this order."""
PRIVILEGED_CHECKS = (
    "is_grasped",
    "at_goal",
    "ee_rest",
    "is_static",
    "opened",
    "closed",
    "touch",
)
"""Checks of the active subtask, keys of ``info``."""
# Forces of contacts are some hundred newtons, which keeps the input of the order of 1.
FORCE_SCALE_N = 1000.0
"""Unit of the force input [N]."""
CUMULATIVE_FORCE_SCALE = 5000.0
"""Unit of the cumulative force input [N x control steps]."""


@dataclass(frozen=True, eq=False)
class AgentObs:
    """Observations of W worlds.

    vector (W, history * V) float32. images (W, history * cameras, height, width) uint8: see `parts.IMAGE_PARTS`.
    privileged (W, P) float32: see PRIVILEGED.
    """

    vector: Tensor
    images: Tensor
    privileged: Tensor

    @classmethod
    def join(cls, parts: Sequence[AgentObs]) -> AgentObs:
        """The rows of several, one after the other."""
        return cls(
            torch.cat([part.vector for part in parts]),
            torch.cat([part.images for part in parts]),
            torch.cat([part.privileged for part in parts]),
        )

    def to(self, device: torch.device) -> AgentObs:
        """Copy on another device."""
        return AgentObs(
            self.vector.to(device), self.images.to(device), self.privileged.to(device)
        )

    def rows(self, index: Any) -> AgentObs:
        """The rows that ``index`` selects."""
        return AgentObs(self.vector[index], self.images[index], self.privileged[index])


class AgentEncoder:
    """Converts an environment's observations into the tensors that an agent takes.

    Args:
        env: environment of either backend.
        layout: inputs of the agent.
        privileged: whether to compute the inputs of a privileged critic, see PRIVILEGED.
        device: of the agent's networks; that of the environment's arrays if not given.
    """

    def __init__(
        self,
        env: PolicyWorlds,
        layout: ObservationSpec,
        privileged: bool,
        device: torch.device | None = None,
    ) -> None:
        self._env = env
        self._layout = layout
        self._privileged = privileged
        self._encoder = ObservationEncoder(env, layout)
        self._numpy = isinstance(env.state.robot_q, np.ndarray)
        self.env_device = torch.as_tensor(env.state.robot_q).device
        self.device = device or self.env_device
        # One scale for all worlds, whatever their subtask.
        self._horizon = float(max(horizons(env.task_config)))

    def begin(self, fresh: Tensor) -> None:
        """Episodes begin in the worlds of ``fresh`` (W,) bool, on the device of the environment."""
        self._encoder.begin(self._array(fresh))

    def executed(self, actions: Tensor) -> None:
        """Tell which actions (W, A), on the device of the environment, are executed before the next observation."""
        self._encoder.executed(self._array(actions))

    def see(
        self, obs: Mapping[str, Any], info: Mapping[str, Any], again: bool = False
    ) -> AgentObs:
        """Convert the observations of one step, see `ObservationEncoder.encode`."""
        encoded = self._encoder.encode(obs, info, again)
        return AgentObs(
            torch.as_tensor(encoded.vector),
            torch.as_tensor(encoded.images),
            self._privileged_of(info),
        ).to(self.device)

    def _array(self, values: Tensor) -> Any:
        """The values in the library of the environment."""
        return values.numpy() if self._numpy else values

    def _privileged_of(self, info: Mapping[str, Any]) -> Tensor:
        worlds = self._env.num_envs
        if not self._privileged:
            # A tensor of width 0, so that all code behind it is the same with and without.
            return torch.zeros(worlds, 0, device=self.env_device)
        columns = [torch.as_tensor(part).float() for part in self._joints]
        numbers = [
            torch.as_tensor(info["steps_left"]).float() / self._horizon,
            torch.as_tensor(info["robot_force"]).float() / FORCE_SCALE_N,
            torch.as_tensor(info["cumulative_force"]).float() / CUMULATIVE_FORCE_SCALE,
            *(torch.as_tensor(info[name]).float() for name in PRIVILEGED_CHECKS),
        ]
        return torch.cat([*columns, torch.stack(numbers, dim=1)], dim=1)

    @property
    def privileged_width(self) -> int:
        """Width P of the privileged input."""
        if not self._privileged:
            return 0
        joints = sum(part.shape[1] for part in self._joints)
        return joints + 3 + len(PRIVILEGED_CHECKS)

    @property
    def _joints(self) -> tuple[Any, ...]:
        """Positions and velocities (W, J) of the joints of robot and furniture."""
        state = self._env.state
        return (state.robot_q, state.robot_qd, state.link_q, state.link_qd)
