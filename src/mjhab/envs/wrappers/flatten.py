"""Observations reduced to state and images, for learners (mshab/envs/wrappers/observation.py)."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv

from mjhab.envs.observations.modes import STATE_KEY
from mjhab.envs.spaces import ordered_dict
from mjhab.envs.wrappers.base import (
    PIXELS,
    ObservationMap,
    check_key,
    dict_space,
    require_images,
)


class FlattenStatePixels(ObservationMap):
    """Keeps ``{"state": (W, S), "pixels": {"<camera>_<output>": images}}``, images with channels first.

    An image (W, H, W, C) becomes (W, C, H, W), a stack of them (W, S, H, W, C) becomes (W, S, C, H, W); both are views
    of the arrays they come from. Cameras are in the order asked for. Everything else
    (camera parameters, point clouds, parts of the state) is left out.

    Raises:
        UsageError: the observations have no images or no state, or are flat already.
    """

    def __init__(self, env: VectorEnv) -> None:
        space = dict_space(env, "FlattenStatePixels")
        leaves = require_images(env, "FlattenStatePixels")
        check_key(STATE_KEY, space)
        self._names = {
            leaf.path[-1]: "_".join(leaf.path[-1].split("/")[1:]) for leaf in leaves
        }
        pixels: dict[str, spaces.Space] = {
            name: _channels_first(space[key]) for key, name in self._names.items()
        }
        super().__init__(
            env, ordered_dict({STATE_KEY: space[STATE_KEY], PIXELS: ordered_dict(pixels)})
        )

    def observation(self, obs: dict[str, Any]) -> dict[str, Any]:
        """State and pixels of an observation."""
        pixels = {
            name: np.moveaxis(obs[key], -1, -3) for key, name in self._names.items()
        }
        return {STATE_KEY: obs[STATE_KEY], PIXELS: pixels}


def _channels_first(space: spaces.Space) -> spaces.Box:
    assert isinstance(space, spaces.Box)
    low = np.moveaxis(space.low, -1, -3)
    high = np.moveaxis(space.high, -1, -3)
    return spaces.Box(low, high, dtype=space.dtype)  # type: ignore[arg-type]
