"""Training environments for stable-baselines3: ``PPO("MultiInputPolicy", to_sb3(env))``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.machine import pip_install


def to_sb3(env: VectorEnv, keys: Sequence[str] = ("state",)) -> Any:
    """Wrap a vector environment as a ``stable_baselines3.common.vec_env.VecEnv``.

    Both reset finished worlds in the step in which they end. The last observation of an episode is in
    ``infos[i]["terminal_observation"]``, and ``infos[i]["TimeLimit.truncated"]`` says that it ended by time, so that
    stable-baselines3 adds the value of what would have followed. ``infos[i]`` holds, besides, "is_success" of ended
    episodes.

    Args:
        env: of `mjhab.make_train` or `mjhab.make`, backend cpu, with ``autoreset="same_step"``.
        keys: entries of the observation that the policy sees. One alone is given as it is, several as a dict; images
            are uint8 or float arrays with the channel last.

    Raises:
        UsageError: stable-baselines3 is not installed, the environment does not reset itself, or a key is unknown.
    """
    try:
        from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UsageError(
            f"to_sb3 needs stable-baselines3: {pip_install('stable-baselines3')}"
        ) from error
    if env.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
        raise UsageError(
            "stable-baselines3 needs an environment that resets itself; make it with autoreset='same_step'."
        )
    known: Any = env.single_observation_space
    for key in keys:
        if key not in known.spaces:
            raise unknown_name("observation", key, tuple(known.spaces))
    worlds = type("Worlds", (_Worlds, VecEnv), {})
    return worlds(env, tuple(keys))


class _Worlds:
    """The methods of a VecEnv over the worlds of one mjhab environment.

    The class of stable-baselines3 is only there once it is imported: `to_sb3` adds it as the second base.
    """

    _seeds: list[int | None]

    def __init__(self, env: VectorEnv, keys: tuple[str, ...]) -> None:
        known: Any = env.single_observation_space
        self._env = env
        self._keys = keys
        self._actions = np.zeros(
            (env.num_envs, *(env.single_action_space.shape or ())), np.float32
        )
        self._succeeded = np.zeros(env.num_envs, bool)
        several = spaces.Dict({key: known[key] for key in keys})
        base: Any = super()
        base.__init__(
            env.num_envs,
            several if len(keys) > 1 else known[next(iter(keys))],
            env.single_action_space,
        )

    def reset(self) -> Any:
        seeds = [seed for seed in self._seeds if seed is not None]
        chosen: Any = seeds if len(seeds) == self._env.num_envs else None
        obs, _ = self._env.reset(seed=chosen)
        base: Any = self
        base._reset_seeds()
        base._reset_options()
        self._succeeded[:] = False
        return self._shown(obs)

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = np.asarray(actions, np.float32)

    def step_wait(self) -> Any:
        obs, reward, terminated, truncated, info = self._env.step(self._actions)
        done = np.asarray(terminated | truncated)
        # What happened in a world that ended is in final_info: `info` is already that of its next episode.
        happened = info.get("final_info", info)
        self._succeeded |= np.asarray(happened["success"], bool)
        infos: list[dict[str, Any]] = [{} for _ in range(self._env.num_envs)]
        for world in np.flatnonzero(done).tolist():
            last = self._shown(info["final_obs"])
            infos[world] = {
                "terminal_observation": _row(last, world),
                "TimeLimit.truncated": bool(truncated[world] and not terminated[world]),
                "is_success": bool(self._succeeded[world]),
            }
        self._succeeded[done] = False
        return self._shown(obs), np.asarray(reward, np.float32), done, infos

    def close(self) -> None:
        self._env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self._env, attr_name)] * self._count(indices)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise UsageError(
            "attributes of single worlds cannot be set; make another environment."
        )

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        raise UsageError(
            "worlds have no methods of their own; call those of the environment."
        )

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self._count(indices)

    def _count(self, indices: Any) -> int:
        base: Any = self
        return len(list(base._get_indices(indices)))

    def _shown(self, obs: dict[str, np.ndarray]) -> Any:
        """What the policy sees of an observation: the one entry asked for, or a dict of several."""
        if len(self._keys) == 1:
            return obs[self._keys[0]]
        return {key: obs[key] for key in self._keys}


def _row(obs: Any, world: int) -> Any:
    if isinstance(obs, dict):
        return {key: value[world] for key, value in obs.items()}
    return obs[world]
