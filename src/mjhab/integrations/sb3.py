"""Training environments for stable-baselines3: ``PPO("MultiInputPolicy", to_sb3(env))``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv

from mjhab.core.errors import UsageError, fault, unknown_name, wrong_value
from mjhab.core.libraries import missing_library
from mjhab.core.machine import pip_install
from mjhab.envs.observations.modes import image_output
from mjhab.envs.wrappers.normalize import normalize_depth

NATURE_CNN_SIDE = 36
"""Smallest image side [px] of stable-baselines3's own network for images: kernels 8, 4, 3 in strides 4, 2, 1."""
BYTE = 255


def to_sb3(
    env: VectorEnv,
    keys: Sequence[str] = ("state",),
    *,
    smallest_side: int = NATURE_CNN_SIDE,
) -> Any:
    """Wrap a vector environment as a ``stable_baselines3.common.vec_env.VecMonitor``.

    Both reset finished worlds in the step in which they end. The last observation of an episode is in
    ``infos[i]["terminal_observation"]``, and ``infos[i]["TimeLimit.truncated"]`` says that it ended by time, so that
    stable-baselines3 adds the value of what would have followed. ``infos[i]`` holds, besides, "is_success" of ended
    episodes, and the monitor "episode", from which come ``rollout/ep_rew_mean`` and ``rollout/ep_len_mean`` of the log.

    Images are uint8 (H, W, C), which stable-baselines3 recognises as images and gives to a CNN. Depth becomes
    ``255 (1 - tanh(metres))``: 255 at the lens and where nothing is hit, 61 at 1 m. Frames of `FrameStack` become
    channels, oldest first.

    Args:
        env: of `mjhab.make_train` or `mjhab.make`, backend cpu, with ``autoreset="same_step"`` and flat keys; it may be
            in `FrameStack`.
        keys: entries of the observation that the policy sees. One alone is given as it is, several as a dict.
        smallest_side: of images [px] that the policy's network takes; that of stable-baselines3's `NatureCNN` by
            default. Give another one with a ``features_extractor_class`` of your own.

    Raises:
        UsageError: stable-baselines3 is not installed, the environment does not reset itself, a key is unknown, or no
            network of stable-baselines3 takes what it names.
    """
    try:
        from stable_baselines3.common.vec_env import (  # pyright: ignore[reportMissingImports]
            VecEnv,
            VecMonitor,
        )
    except ImportError as error:
        raise missing_library(
            "to_sb3", ("stable-baselines3",), pip_install("stable-baselines3")
        ) from error
    mode = env.metadata.get("autoreset_mode")
    if mode != AutoresetMode.SAME_STEP:
        raise wrong_value("autoreset", mode, "'same_step' for stable-baselines3")
    known: Any = env.single_observation_space
    for key in keys:
        if key not in known.spaces:
            raise unknown_name("observation", key, tuple(known.spaces))
    seen = [_Seen(key, known[key], smallest_side) for key in keys]
    worlds = type("Worlds", (_Sb3Worlds, VecEnv), {})
    return VecMonitor(worlds(env, seen))


class _Seen:
    """One entry of the observation as stable-baselines3 takes it: images as bytes, everything else unchanged.

    Raises:
        UsageError: no network of stable-baselines3 takes it.
    """

    def __init__(self, key: str, space: spaces.Space, smallest_side: int) -> None:
        self.key = key
        self._output = image_output(key)
        if not isinstance(space, spaces.Box):
            raise fault(
                "to_sb3",
                f"{key!r} is a group of observations. Leave out obs_keys='nested' and FlattenStatePixels; "
                "images are named by keys like 'sensor_data/CAMERA/depth'.",
            )
        self.space = space
        if self._output:
            self.space = self._image_space(space, smallest_side)

    def _image_space(self, space: spaces.Box, smallest_side: int) -> spaces.Box:
        if self._output == "seg":
            raise fault(
                "to_sb3",
                f"{self.key!r} holds ids, which stable-baselines3 would take for amounts; it has networks for "
                "depth and rgb.",
            )
        if not np.issubdtype(space.dtype, np.integer):
            raise fault(
                "to_sb3",
                f"{self.key!r} is {space.dtype}, but stable-baselines3 takes bytes and scales them itself: "
                "leave out NormalizeImages.",
            )
        *_, height, width, _channels = space.shape
        if min(height, width) < smallest_side:
            raise fault(
                "to_sb3",
                f"{self.key!r} is {width} x {height} px, but stable-baselines3's NatureCNN takes "
                f"{smallest_side} px or more: make the environment with camera_size={smallest_side} or more, "
                "or give smallest_side with a features_extractor_class of your own.",
            )
        shape = self.of(np.zeros((1, *space.shape), space.dtype)).shape[1:]
        return spaces.Box(0, BYTE, shape, np.uint8)

    def of(self, values: np.ndarray) -> np.ndarray:
        """What the policy sees of the environment's values (W, ...)."""
        if not self._output:
            return values
        if self._output == "depth":
            # Rounded, because a cast would cut off and darken every picture a little.
            values = np.rint(BYTE * normalize_depth(values)).astype(np.uint8)
        stacked = values.ndim == 5
        return _frames_as_channels(values) if stacked else values


def _frames_as_channels(frames: np.ndarray) -> np.ndarray:
    """Stacked images (W, S, H, W, C) as (W, H, W, S * C), oldest frame first."""
    last = np.moveaxis(frames, 1, -2)
    return last.reshape(*last.shape[:-2], -1)


class _Sb3Worlds:
    """The methods of a VecEnv over the worlds of one mjhab environment.

    The class of stable-baselines3 is only there once it is imported: `to_sb3` adds it as the second base.
    """

    _seeds: list[int | None]

    def __init__(self, env: VectorEnv, seen: Sequence[_Seen]) -> None:
        self._env = env
        self._seen = seen
        self._actions = np.zeros(
            (env.num_envs, *(env.single_action_space.shape or ())), np.float32
        )
        self._succeeded = np.zeros(env.num_envs, bool)
        several = spaces.Dict({part.key: part.space for part in seen})
        base: Any = super()
        base.__init__(
            env.num_envs,
            several if len(seen) > 1 else seen[0].space,
            env.single_action_space,
        )

    def reset(self) -> Any:
        seeds = [seed for seed in self._seeds if seed is not None]
        # stable-baselines3 leaves seeds empty after the first reset, and episodes then go on.
        chosen: Any = seeds if len(seeds) == self._env.num_envs else None
        obs, _ = self._env.reset(seed=chosen)
        base: Any = self
        # A seed given once is for one reset, as in stable-baselines3's own environments.
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
                # stable-baselines3 adds the value of what would have followed where this is set.
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
        shown = {part.key: part.of(obs[part.key]) for part in self._seen}
        return shown if len(shown) > 1 else shown[self._seen[0].key]


def _row(obs: Any, world: int) -> Any:
    if isinstance(obs, dict):
        return {key: value[world] for key, value in obs.items()}
    return obs[world]
