"""The vector environment around the worlds: those that ended begin their next episode in the same step."""

from __future__ import annotations

from typing import Any

import gymnasium
import torch
from gymnasium.vector import AutoresetMode, VectorEnv

from mjhab.compat.mshab.tools.trees import torch_clone_dict


class ManiSkillVectorEnv(VectorEnv):
    """W worlds as Gymnasium's `VectorEnv`, with resets in the step that ends an episode.

    In a step in which some world ends, ``info`` is that of the new episodes, with "final_info" and "final_observation"
    of the step that was taken, of all worlds, and "_final_info", "_final_observation", "_elapsed_steps" (W,) bool for
    those that ended.

    Args:
        env: an environment of `worlds.env` in its wrappers, or its id.
        num_envs, **kwargs: for an id, as ``gymnasium.make`` takes them.
        auto_reset: whether worlds are reset at all.
        ignore_terminations: only time ends an episode.
        record_metrics: ``info["episode"]`` has "return", "episode_len", "reward" (return per step), "success_once",
            "fail_once", and with ignore_terminations "success_at_end", "fail_at_end", each (W,).
    """

    def __init__(
        self,
        env: gymnasium.Env | str,
        num_envs: int = 1,
        auto_reset: bool = True,
        ignore_terminations: bool = False,
        record_metrics: bool = False,
        **kwargs: Any,
    ) -> None:
        made = env if isinstance(env, gymnasium.Env) else None
        self._env: Any = made or gymnasium.make(str(env), num_envs=num_envs, **kwargs)
        base: Any = self._env.unwrapped
        self.num_envs = base.num_envs
        self.auto_reset = auto_reset
        self.ignore_terminations = ignore_terminations
        self.record_metrics = record_metrics
        self.spec = self._env.spec
        mode = AutoresetMode.SAME_STEP if auto_reset else AutoresetMode.DISABLED
        self.metadata = {**self._env.metadata, "autoreset_mode": mode}
        self.single_observation_space = base.single_observation_space
        self.observation_space = base.observation_space
        self.single_action_space = base.single_action_space
        self.action_space = base.action_space
        self._once = {
            name: torch.zeros(self.num_envs, dtype=torch.bool, device=base.device)
            for name in ("success", "fail")
        }
        self._returns = torch.zeros(self.num_envs, device=base.device)

    @property
    def base_env(self) -> Any:
        """The environment of `worlds.env`."""
        return self._env.unwrapped

    @property
    def unwrapped(self) -> Any:
        """The environment of `worlds.env`."""
        return self.base_env

    @property
    def env(self) -> Any:
        """The environment in its wrappers."""
        return self._env

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.base_env.device

    @property
    def max_episode_steps(self) -> int | None:
        """Control steps after which time ends an episode."""
        return find_max_episode_steps_value(self._env)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes in all worlds, or in those of ``options["env_idx"]``."""
        obs, info = self._env.reset(seed=seed, options=options)
        begun: Any = (
            slice(None) if options is None else options.get("env_idx", slice(None))
        )
        for name, once in self._once.items():
            # info of earlier steps holds the tensor that is changed here.
            self._once[name] = once.clone()
            self._once[name][begun] = False
        self._returns = self._returns.clone()
        self._returns[begun] = 0
        return obs, info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step, and the resets of the worlds that ended in it."""
        obs, reward, terminated, truncated, info = self._env.step(actions)
        if self.record_metrics:
            info["episode"] = self._metrics(reward, info)
        if self.ignore_terminations:
            terminated = torch.zeros_like(terminated)
        done = terminated | truncated
        if not (self.auto_reset and bool(done.any())):
            return obs, reward, terminated, truncated, info
        final_obs = torch_clone_dict(obs)
        final_info = torch_clone_dict(info)
        ended = torch.nonzero(done)[:, 0]
        obs, info = self.reset(options={"env_idx": ended})
        info = {
            **info,
            "final_observation": final_obs,
            "final_info": final_info,
            "_final_info": done,
            "_final_observation": done,
            "_elapsed_steps": done,
        }
        return obs, reward, terminated, truncated, info

    def _metrics(self, reward: torch.Tensor, info: dict[str, Any]) -> dict[str, Any]:
        """Figures of the present episodes."""
        self._returns = self._returns + reward
        length = self.base_env.elapsed_steps.clone()
        told = {"return": self._returns, "episode_len": length}
        told["reward"] = self._returns / length
        for name in self._once:
            self._once[name] = self._once[name] | info[name]
            told[f"{name}_once"] = self._once[name]
            if self.ignore_terminations:
                told[f"{name}_at_end"] = info[name].clone()
        return told

    def render(self) -> Any:
        """Human views of all worlds."""
        return self.base_env.render()

    def call(self, name: str, *args: Any, **kwargs: Any) -> Any:
        """Call a method of the environment in its wrappers."""
        return getattr(self._env, name)(*args, **kwargs)

    def close_extras(self, **_: Any) -> None:
        """Close the worlds."""
        self._env.close()


def find_max_episode_steps_value(env: gymnasium.Env | ManiSkillVectorEnv) -> int | None:
    """Control steps after which time ends an episode of an environment in its wrappers; None if it does not."""
    at = env._env if isinstance(env, ManiSkillVectorEnv) else env
    while at is not None:
        # vars, because getattr would be passed on to what lies below.
        limit = vars(at).get("_max_episode_steps") or vars(at).get("max_episode_steps")
        if limit is not None:
            return limit
        at = vars(at).get("env")
    spec = getattr(env, "spec", None)
    return None if spec is None else spec.max_episode_steps
