"""A vector environment of points on a line that shall come to rest at 0: learned in seconds."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from mjhab.core.conventions.names import Conventions
from mjhab.learning.configs import InputConfig, NetworkConfig
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.reinforcement.agent_encoder import AgentEncoder
from mjhab.learning.reinforcement.configs import (
    PPO,
    SAC,
    PpoConfig,
    ReinforcementConfig,
    SacConfig,
)
from mjhab.tasks.subtasks.registry import SUBTASKS

HORIZON = 8
INPUTS = InputConfig(
    cameras=(),
    image_size=0,
    previous_action=False,
    condition=False,
    normalize=True,
    shift=0,
)
LAYOUT = ObservationSpec(INPUTS, (("place", 1),), ("left_right",), (), ("pd", "forward"))
NETWORK = NetworkConfig(hidden=32, layers=2)
PPO_TOY = ReinforcementConfig(
    PPO,
    "toy",
    INPUTS,
    NETWORK,
    ppo=PpoConfig(rollout_steps=16, minibatches=4, gamma=0.9, learning_rate=3e-3),
    worlds=16,
)
SAC_TOY = ReinforcementConfig(
    SAC,
    "toy",
    INPUTS,
    NETWORK,
    sac=SacConfig(
        gamma=0.8,
        batch=64,
        atoms=31,
        value_high=5.0,
        learning_rate=3e-3,
        warm_up=64,
        capacity=4096,
    ),
    worlds=16,
)


class Toy:
    """W points; an action moves a point by up to 0.3, the reward is 1 - |place|, and 8 steps are an episode.

    ``force`` (W,): what acts on the robot in every step [N].
    """

    def __init__(self, worlds: int, terminates: bool = False) -> None:
        self.num_envs = worlds
        self.config = SimpleNamespace(autoreset="disabled")
        limits = {name: SimpleNamespace(horizon=HORIZON) for name in SUBTASKS}
        self.task_config = SimpleNamespace(limits=limits)
        self.single_action_space = SimpleNamespace(shape=(1,))
        self.terminates = terminates
        self._random = np.random.default_rng(0)
        self.place = np.zeros(worlds)
        self.left = np.zeros(worlds, np.int64)
        self.force = np.zeros(worlds)
        self.forces = np.zeros(worlds)

    def link_state(self) -> np.ndarray:
        """There is no link."""
        return np.zeros((self.num_envs, 5), np.float32)

    def state_as(self, conventions: Conventions) -> np.ndarray:
        """The state has neither objects nor joints: it is the same in all conventions."""
        return self._obs()["state"]

    @property
    def state(self) -> Any:
        """Joints, for a privileged critic: the place."""
        nothing = np.zeros((self.num_envs, 0))
        place = self.place[:, None]
        return SimpleNamespace(
            robot_q=place, robot_qd=nothing, link_q=nothing, link_qd=nothing
        )

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict, dict]:
        if seed is not None:
            self._random = np.random.default_rng(seed)
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        self.place = np.where(
            mask, self._random.uniform(-1, 1, self.num_envs), self.place
        )
        self.left = np.where(mask, HORIZON, self.left)
        self.forces = np.where(mask, 0.0, self.forces)
        return self._obs(), self._info()

    def step(self, actions: np.ndarray) -> tuple[dict, Any, Any, Any, dict]:
        self.place = self.place + 0.3 * np.clip(actions[:, 0], -1, 1)
        self.left = self.left - 1
        self.forces = self.forces + self.force
        over = self.left == 0
        terminated = over if self.terminates else np.zeros_like(over)
        return (
            self._obs(),
            1.0 - np.abs(self.place),
            terminated,
            over & ~terminated,
            self._info(),
        )

    def _obs(self) -> dict:
        return {"state": self.place[:, None].astype(np.float32)}

    def _info(self) -> dict:
        zeros = np.zeros(self.num_envs)
        info: dict[str, Any] = {
            "steps_left": self.left,
            "success": np.abs(self.place) < 0.1,
        }
        info |= {"robot_force": self.force, "cumulative_force": self.forces}
        info["force_ok"] = self.forces <= 1000.0
        names = ("is_grasped", "at_goal", "ee_rest")
        info |= dict.fromkeys((*names, "is_static", "opened", "closed", "touch"), zeros)
        return info


def encoder_of(
    env: Any, layout: ObservationSpec = LAYOUT, privileged: bool = False
) -> AgentEncoder:
    """The encoder of a toy, which has the few things of an environment that an encoder reads."""
    return AgentEncoder(env, layout, privileged)
