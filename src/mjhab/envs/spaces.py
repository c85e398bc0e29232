"""Spaces of environments. Dict spaces keep the order of their keys; Gymnasium would sort those of a plain dict."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from mjhab.config.env import EnvConfig
from mjhab.robots.controllers.controller import Controller

SEPARATOR = "/"
"""Separator between the parts of a flat observation key."""


def ordered_dict(parts: Mapping[str, spaces.Space]) -> spaces.Dict:
    """A Dict space with the keys in the order given."""
    return spaces.Dict(OrderedDict(parts))


def batched(space: spaces.Space, count: int) -> spaces.Space:
    """The space of ``count`` worlds, keys in the order of ``space``."""
    if isinstance(space, spaces.Dict):
        return ordered_dict(
            {key: batched(part, count) for key, part in space.spaces.items()}
        )
    return batch_space(space, count)


def action_space(controller: Controller) -> spaces.Box:
    """The action space of one world, (A,)."""
    return spaces.Box(controller.low, controller.high, dtype=np.float32)


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """``{"extra/is_grasped": a, "state": b}`` as ``{"extra": {"is_grasped": a}, "state": b}``."""
    tree: dict[str, Any] = {}
    for key, value in flat.items():
        *folders, name = key.split(SEPARATOR)
        place = tree
        for folder in folders:
            place = place.setdefault(folder, {})
        place[name] = value
    return tree


def keyed_space(flat: spaces.Dict, config: EnvConfig) -> spaces.Dict:
    """Convert a Dict space with flat keys to the key style of ``config.obs_keys``: flat or nested."""

    def box(tree: Mapping[str, Any]) -> spaces.Dict:
        return ordered_dict(
            {k: box(v) if isinstance(v, dict) else v for k, v in tree.items()}
        )

    return flat if config.has_flat_keys else box(nested(flat.spaces))
