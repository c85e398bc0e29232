"""Training environments for rsl_rl, the learner of Isaac Lab, mjlab and MuJoCo Playground, on both backends."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium.vector import AutoresetMode, VectorEnv

from mjhab.core.errors import wrong_value
from mjhab.core.libraries import missing_library
from mjhab.core.machine import pip_install
from mjhab.integrations.tensors import observation_tensors
from mjhab.tasks.subtasks.registry import horizons


def to_rsl_rl(env: VectorEnv) -> Any:
    """Wrap a vector environment as a ``rsl_rl.env.VecEnv``.

    Observations are TensorDicts: group "state" (W, S), and one group per image ("<camera>/depth" and so on), see
    `observation_tensors`.

    ``extras["time_outs"]`` marks episodes that ended by time; rsl_rl adds the value of what would have
    followed to their last reward.

    Args:
        env: of `mjhab.make_train` or `mjhab.make`, with ``autoreset="same_step"``.

    Raises:
        UsageError: rsl-rl-lib is not installed, or the environment does not reset itself.
    """
    try:
        from rsl_rl.env import VecEnv  # pyright: ignore[reportMissingImports]
        from tensordict import TensorDict  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise missing_library(
            "to_rsl_rl", ("rsl_rl",), pip_install("rsl-rl-lib")
        ) from error
    _require_own_resets(env)
    numpy = not env.metadata.get("tensors", False)

    # Defined here, because its base exists only where rsl_rl is installed.
    class RslRlWorlds(VecEnv):
        """The worlds of one mjhab environment."""

        def __init__(self) -> None:
            self.num_envs = env.num_envs
            self.num_actions = int(env.single_action_space.shape[0])  # type: ignore[index]
            self.max_episode_length = max(horizons(env.unwrapped.task_config))  # type: ignore[attr-defined]
            obs, _ = env.reset(seed=env.unwrapped.config.seed)  # type: ignore[attr-defined]
            self.device = torch.as_tensor(obs["state"]).device
            self.episode_length_buf = torch.zeros(
                self.num_envs, dtype=torch.long, device=self.device
            )
            self.cfg = {}
            self._obs = self._grouped(obs)

        def get_observations(self) -> Any:
            return self._obs

        def step(
            self, actions: torch.Tensor
        ) -> tuple[Any, torch.Tensor, torch.Tensor, dict]:
            given = actions.detach().cpu().numpy() if numpy else actions
            obs, reward, terminated, truncated, info = env.step(given)
            self._obs = self._grouped(obs)
            terminated = torch.as_tensor(terminated)
            truncated = torch.as_tensor(truncated)
            done = terminated | truncated
            self.episode_length_buf = torch.where(done, 0, self.episode_length_buf + 1)
            # `info` of a world that ended is already that of its next episode.
            happened = torch.as_tensor(info.get("final_info", info)["success"]).float()
            extras = {
                # rsl_rl adds the value of what would have followed, which a terminated episode lacks.
                "time_outs": truncated & ~terminated,
                "log": {"/success": happened.mean()},
            }
            return self._obs, torch.as_tensor(reward).float(), done, extras

        def _grouped(self, obs: dict[str, Any]) -> Any:
            groups = observation_tensors(obs)
            return TensorDict(groups, batch_size=[self.num_envs], device=self.device)

    return RslRlWorlds()


def _require_own_resets(env: VectorEnv) -> None:
    """Refuse environments whose worlds do not begin a new episode in the step that ends one."""
    mode = env.metadata.get("autoreset_mode")
    if mode != AutoresetMode.SAME_STEP:
        raise wrong_value("autoreset", mode, "'same_step' for rsl_rl")
