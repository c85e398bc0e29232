"""Observations for agents: tensors on the device of the environment's arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from mjhab.core.names import kind_of
from mjhab.learning.demos import base_velocity, nearness
from mjhab.learning.layout import Layout
from mjhab.tasks.subtasks.registry import horizons

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
FORCE_SCALE_N = 1000.0
"""Unit of the force input [N]."""
CUMULATIVE_FORCE_SCALE = 5000.0
"""Unit of the cumulative force input [N x control steps]."""
FARTHEST_MM = 32_767
"""Largest depth that an int16 depth image can hold [mm]."""


class SteppedEnv(Protocol):
    """The part of an environment that `Sight` reads; ``state`` is a `sim.protocol.SimState`."""

    num_envs: int
    config: Any
    task_config: Any

    @property
    def state(self) -> Any:
        """State of the simulator."""
        ...

    def link_state(self) -> Any:
        """(W, 5) float32, see `Sensing.link_state`."""
        ...


@dataclass(frozen=True, eq=False)
class Seen:
    """Observations of W worlds.

    vector (W, history * V) float32. images (W, history * cameras, height, width) uint8: see `learning.demos.nearness`.
    privileged (W, P) float32: see PRIVILEGED.
    """

    vector: Tensor
    images: Tensor
    privileged: Tensor

    def to(self, device: torch.device) -> Seen:
        """Copy on another device."""
        return Seen(
            self.vector.to(device), self.images.to(device), self.privileged.to(device)
        )

    def rows(self, index: Any) -> Seen:
        """The rows that ``index`` selects."""
        return Seen(self.vector[index], self.images[index], self.privileged[index])


class Sight:
    """Converts an environment's observations into the tensors that an agent takes.

    Args:
        env: environment of either backend.
        layout: inputs of the agent.
        privileged: whether to compute the inputs of a privileged critic, see PRIVILEGED.
    """

    def __init__(self, env: SteppedEnv, layout: Layout, privileged: bool) -> None:
        self._env = env
        self._layout = layout
        self._privileged = privileged
        like = torch.as_tensor(env.state.robot_q)
        self.device = like.device
        self._near = torch.from_numpy(
            nearness(np.arange(FARTHEST_MM + 1, dtype=np.int16))
        )
        self._near = self._near.to(self.device)
        worlds = env.num_envs
        inputs = layout.inputs
        size = inputs.image_size if layout.image_keys else 0
        frames = (len(layout.image_keys), size, size)
        self._vectors = torch.zeros(
            worlds, inputs.history, layout.width, device=self.device
        )
        self._images = torch.zeros(
            worlds, inputs.history, *frames, dtype=torch.uint8, device=self.device
        )
        self._codes = torch.zeros(worlds, layout.condition_width, device=self.device)
        self._horizon = float(max(horizons(env.task_config)))

    def begin(self, fresh: Tensor, info: Mapping[str, Any]) -> None:
        """Set the subtask condition of the worlds in ``fresh`` (W,) bool from their new episodes."""
        layout = self._layout
        if not layout.condition_width:
            return
        for world in torch.nonzero(fresh).flatten().tolist():
            episode = self._episode(info, world)
            first = episode["plan"][0]
            sentence = episode["instructions"][0] if layout.inputs.sentence else ""
            code = layout.condition(first["kind"], kind_of(first["target"]), sentence)
            self._codes[world] = torch.from_numpy(code).to(self.device)

    def _episode(self, info: Mapping[str, Any], world: int) -> Mapping[str, Any]:
        described = info.get("episode_spec")
        if described is None:
            return self._env.episode_spec(world)  # type: ignore[attr-defined]
        return described[world]

    def see(
        self,
        obs: Mapping[str, Any],
        info: Mapping[str, Any],
        last: Tensor,
        fresh: Tensor,
        again: bool = False,
    ) -> Seen:
        """Convert the observations of one step.

        Args:
            obs: observations. info: of the same step.
            last: (W, A) actions of the previous step. fresh: (W,) bool, worlds whose episodes start here.
            again: only the fresh worlds have changed since the last call; the histories of the others stay.
        """
        parts = [torch.as_tensor(obs["state"]).float()]
        inputs = self._layout.inputs
        if inputs.base_velocity:
            state = self._env.state
            parts.append(torch.as_tensor(base_velocity(state.robot_q, state.robot_qd)))
        if inputs.link_state:
            parts.append(torch.as_tensor(self._env.link_state()))
        if inputs.previous_action:
            parts.append(last)
        if self._layout.condition_width:
            parts.append(self._codes)
        vector = torch.cat(parts, dim=1)[:, None]
        images = self._frames(obs)[:, None]
        if inputs.history == 1:
            self._vectors = vector
            self._images = images
        else:
            self._vectors = _shifted(self._vectors, vector, fresh, again)
            self._images = _shifted(self._images, images, fresh, again)
        return Seen(
            self._vectors.flatten(1),
            self._images.flatten(1, 2),
            self._privileged_of(info),
        )

    def _frames(self, obs: Mapping[str, Any]) -> Tensor:
        """Images (W, cameras, height, width) uint8 of one step."""
        keys = self._layout.image_keys
        if not keys:
            return self._images[:, -1]
        depths = [torch.as_tensor(obs[key])[..., 0] for key in keys]
        return torch.stack(
            [self._near[depth.clamp(min=0).long()] for depth in depths], dim=1
        )

    def _privileged_of(self, info: Mapping[str, Any]) -> Tensor:
        worlds = self._env.num_envs
        if not self._privileged:
            return torch.zeros(worlds, 0, device=self.device)
        state = self._env.state
        parts = [state.robot_q, state.robot_qd, state.link_q, state.link_qd]
        columns = [torch.as_tensor(part).float() for part in parts]
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
        state = self._env.state
        parts = (state.robot_q, state.robot_qd, state.link_q, state.link_qd)
        joints = sum(part.shape[1] for part in parts)
        return joints + 3 + len(PRIVILEGED_CHECKS)


def _shifted(history: Tensor, now: Tensor, fresh: Tensor, again: bool) -> Tensor:
    """Append ``now`` (W, 1, ...) to a history (W, H, ...); fresh worlds get a history of ``now`` only."""
    moved = history if again else torch.cat([history[:, 1:], now], dim=1)
    mask = fresh.view(-1, *[1] * (now.dim() - 1))
    return torch.where(mask, now.expand_as(moved), moved)
