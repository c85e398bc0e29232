"""Common parts of the observation wrappers: spaces, images in an observation, final observations."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv, VectorWrapper

from mjhab.core.errors import UsageError, fault, unknown_name
from mjhab.envs.spaces import batched

IMAGE_PREFIX = "sensor_data/"
PIXELS = "pixels"
FINAL = "final_obs"


@dataclass(frozen=True)
class ImageLeaf:
    """An image in an observation.

    Attributes:
        path: keys that lead to it.
        output: "depth", "rgb" or "seg".
        channels: axis of the channels.
    """

    path: tuple[str, ...]
    output: str
    channels: int


def dict_space(env: VectorEnv, wrapper: str) -> spaces.Dict:
    """The environment's observation space of one world.

    Raises:
        UsageError: not a Dict, or observations that are tensors on a device.
    """
    if env.metadata.get("tensors"):
        raise fault(
            wrapper,
            f"works on numpy arrays, but {env} gives torch tensors; use backend='cpu'",
        )
    space = env.single_observation_space
    if isinstance(space, spaces.Dict) and isinstance(
        # Nested observations have a dict of this name.
        space.spaces.get("agent"),
        spaces.Dict,
    ):
        raise fault(wrapper, "takes flat observation keys: leave out obs_keys='nested'.")
    if not isinstance(space, spaces.Dict):
        raise fault(
            wrapper, f"needs observations that are a dict; those of {env} are {space}."
        )
    return space


def image_leaves(space: spaces.Dict) -> Iterator[ImageLeaf]:
    """Images of a space: "sensor_data/<camera>/<output>", channels last, and after FlattenStatePixels
    "pixels"/"<camera>_<output>", channels before height and width."""
    for key in space.spaces:
        if key.startswith(IMAGE_PREFIX):
            yield ImageLeaf((key,), key.rsplit("/", 1)[1], -1)
    pixels = space.spaces.get(PIXELS)
    for key in pixels.spaces if isinstance(pixels, spaces.Dict) else ():
        yield ImageLeaf((PIXELS, key), key.rsplit("_", 1)[1], -3)


def require_images(
    env: VectorEnv, wrapper: str, flat: bool = False
) -> tuple[ImageLeaf, ...]:
    """Find the images of an environment's observations.

    Args:
        env: vector environment.
        wrapper: name of the wrapper, for messages.
        flat: accept the images of FlattenStatePixels, too.

    Raises:
        UsageError: there are no images, or they are flat and must not be.
    """
    leaves = tuple(image_leaves(dict_space(env, wrapper)))
    if not leaves:
        raise fault(
            wrapper,
            "the observations have no images; make the environment with obs_mode='depth'.",
        )
    if not flat and any(leaf.path[0] == PIXELS for leaf in leaves):
        raise fault(
            wrapper,
            "must come before FlattenStatePixels, and FlattenStatePixels once only.",
        )
    return leaves


def check_key(key: str, space: spaces.Dict) -> None:
    """Check that a key is in a space.

    Raises:
        UsageError: it is not.
    """
    if key not in space.spaces:
        raise unknown_name("observation key", key, space.spaces)


class ObservationMap(VectorWrapper, ABC):
    """Applies ``observation`` to the observations of reset and step, and to the final observation in ``info``.

    It has no state, so that it works alike in every autoreset mode.
    """

    def __init__(self, env: VectorEnv, single_space: spaces.Dict) -> None:
        super().__init__(env)
        # torchrl's GymWrapper looks for it; Gymnasium's wrappers do not pass it on.
        self.autoreset_mode = env.metadata.get("autoreset_mode")
        self.single_observation_space = single_space
        self.observation_space = batched(single_space, env.num_envs)

    @abstractmethod
    def observation(self, obs: dict[str, Any]) -> dict[str, Any]:
        """Transform an observation of all worlds."""

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict]:
        """Reset the environment and transform the observation."""
        obs, info = self.env.reset(seed=seed, options=options)
        return self.observation(obs), info

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step the environment and transform the observation."""
        obs, reward, terminated, truncated, info = self.env.step(actions)
        return (
            self.observation(obs),
            reward,
            terminated,
            truncated,
            map_final(info, self.observation),
        )


def map_final(
    info: dict[str, Any], change: Callable[[dict[str, Any]], dict[str, Any]]
) -> dict[str, Any]:
    """``info`` with its final observation, if there is one, put through ``change``.

    Raises:
        UsageError: the final observation is not a dict of arrays over all worlds.
    """
    if FINAL not in info:
        return info
    if not isinstance(info[FINAL], dict):
        need = f"info[{FINAL!r}] must be a dict of (num_envs, ...) arrays like the observation"
        raise UsageError(
            f"{need}, as mjhab environments give it; got {type(info[FINAL]).__name__}."
        )
    return {**info, FINAL: change(info[FINAL])}
