"""Observations of mjhab as those of MS-HAB: nested tensors in its order, names and types."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from mjhab.core.errors import wrong_type
from mjhab.envs.observations.modes import STATE_KEY

GRASP = ("extra", "is_grasped")
PARTS = ("agent", "extra", "sensor_param", "sensor_data")
"""Top level of an observation, in order."""
_SEGMENTS = ("seg", "segmentation")
"""Our name of a picture of segments, and theirs."""


def as_tensor(values: Any) -> torch.Tensor:
    """An array as a tensor that shares its memory; a tensor as it is."""
    return values if isinstance(values, torch.Tensor) else torch.from_numpy(values)


class Reading:
    """How the observations of an environment of ours become those of MS-HAB's.

    Args:
        flat: space of one world with our flat keys.
        mode: observation mode of ManiSkill, see `arguments.OBS_MODES`.
    """

    def __init__(self, flat: spaces.Dict, mode: str) -> None:
        self._mode = mode
        self._paths = [
            (key, tuple(key.split("/"))) for key in flat.spaces if key != STATE_KEY
        ]
        order = {part: at for at, part in enumerate(PARTS)}
        # A flat state vector lays entries side by side, so policies depend on this order.
        self._paths.sort(key=lambda each: order.get(each[1][0], len(PARTS)))

    def read(self, obs: Mapping[str, Any]) -> Any:
        """An observation (W, ...) of ours, as the mode asks for it."""
        if self._mode == "state":
            return as_tensor(obs[STATE_KEY])
        if self._mode == "none":
            return {}
        tree: dict[str, Any] = {}
        for key, path in self._paths:
            place = tree
            for folder in path[:-1]:
                place = place.setdefault(folder, {})
            name = path[-1]
            values = as_tensor(obs[key])
            if path == GRASP:
                values = values[:, 0] > 0
            elif name == _SEGMENTS[0]:
                name = _SEGMENTS[1]
                # The type of ManiSkill's pictures of segments.
                values = values.to(torch.int16)
            place[name] = values
        return tree


def space_of(obs: Any) -> spaces.Space:
    """Space of one world for observations (W, ...), tensors or arrays in nested dicts.

    Raises:
        UsageError: an entry is no tensor and no array.
    """
    if isinstance(obs, Mapping):
        # Of a plain dict Gymnasium would sort the keys.
        return spaces.Dict(OrderedDict((key, space_of(obs[key])) for key in obs))
    if isinstance(obs, torch.Tensor):
        # Without its numbers, which may be on a device.
        obs = torch.empty(obs.shape, dtype=obs.dtype).numpy()
    if not isinstance(obs, np.ndarray):
        raise wrong_type("an entry of an observation", obs, "a tensor or an array")
    low, high = _bounds(obs.dtype)
    return spaces.Box(low, high, obs.shape[1:], obs.dtype.type)


def _bounds(dtype: np.dtype) -> tuple[float, float]:
    if dtype.kind == "f":
        return -np.inf, np.inf
    if dtype.kind == "b":
        return 0, 1
    info = np.iinfo(dtype)
    return info.min, info.max


def blank(space: spaces.Space, worlds: int) -> Any:
    """An observation (W, ...) of zeros in the space of one world."""
    if isinstance(space, spaces.Dict):
        return {key: blank(part, worlds) for key, part in space.spaces.items()}
    shape = (worlds, *(space.shape or ()))
    return np.zeros(shape, space.dtype)
