"""Spaces of environments. Dict spaces keep the order of their keys; Gymnasium would sort those of a plain dict."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim, flatten, flatten_space, unflatten
from gymnasium.vector.utils import batch_space

from mjhab.config.env import NESTED, WHOLE, EnvConfig
from mjhab.envs.observations.modes import STATE_KEY
from mjhab.robots.controllers.controller import Controller

SEPARATOR = "/"
"""Separator between the parts of a flat observation key."""


def ordered_dict(parts: Mapping[str, spaces.Space]) -> spaces.Dict:
    """A Dict space with the keys in the order given."""
    # An ordered dict is the one thing whose keys Gymnasium does not sort.
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


def keyed_space(flat: ObservationSpace, config: EnvConfig) -> spaces.Dict:
    """Convert the space of observations with flat keys to the key style of ``config.obs_keys``."""
    if config.obs_keys == NESTED:
        columns = {
            tuple(key.split(SEPARATOR)): part for (key,), part in flat.columns.items()
        }
        return ObservationSpace(_boxed(nested(flat.spaces)).spaces, columns)
    return flat.once if config.obs_keys == WHOLE else flat


def _boxed(tree: Mapping[str, Any]) -> spaces.Dict:
    return ordered_dict(
        {k: _boxed(v) if isinstance(v, dict) else v for k, v in tree.items()}
    )


Path = tuple[str, ...]
"""Keys that lead to an entry of nested dicts."""


class ObservationSpace(spaces.Dict):
    """A Dict space that holds the state and, as entries of their own, its parts; Gymnasium flattens the state once.

    Without this, ``FlattenObservation`` would give learners every number of the state twice.

    Args:
        parts: entries by key, in order; one is STATE_KEY.
        columns: path of every part of the state, and its columns of the state.

    Attributes:
        once: the space without the parts of the state.
    """

    def __init__(
        self, parts: Mapping[str, spaces.Space], columns: Mapping[Path, slice]
    ) -> None:
        super().__init__(OrderedDict(parts))
        self.columns = dict(columns)
        self.once = _boxed(without(self.spaces, self.columns))


def with_entries(space: spaces.Dict, changed: Mapping[str, spaces.Space]) -> spaces.Dict:
    """A space with some entries changed, of the same kind as long as the state and its parts stay as they are."""
    parts = {**space.spaces, **changed}
    if not isinstance(space, ObservationSpace):
        return ordered_dict(parts)
    fixed = {STATE_KEY, *(path[0] for path in space.columns)}
    # Columns of the state mean nothing once the state is another one.
    same = all(parts[key] == space[key] for key in fixed)
    return ObservationSpace(parts, space.columns) if same else ordered_dict(parts)


def without(tree: Mapping[str, Any], paths: Collection[Path]) -> dict[str, Any]:
    """A copy of nested dicts, or Dict spaces, without the entries at ``paths`` and dicts that are empty then."""
    kept: dict[str, Any] = {}
    for key, value in tree.items():
        below = [path[1:] for path in paths if path[0] == key]
        if () in below:
            continue
        if below:
            value = without(value, below)
            # A dict all of whose entries are gone would be an empty space.
            if not value:
                continue
        kept[key] = value
    return kept


@flatdim.register
def _flatdim(space: ObservationSpace) -> int:
    return flatdim(space.once)


@flatten_space.register
def _flatten_space(space: ObservationSpace) -> Any:
    return flatten_space(space.once)


@flatten.register
def _flatten(space: ObservationSpace, x: Any) -> Any:
    return flatten(space.once, without(x, space.columns))


@unflatten.register
def _unflatten(space: ObservationSpace, x: Any) -> Any:
    once = unflatten(space.once, x)
    assert isinstance(once, dict)
    return _in_order(space, once, once[STATE_KEY], space.columns)


def _in_order(
    space: spaces.Dict,
    once: Mapping[str, Any],
    state: np.ndarray,
    columns: Mapping[Path, slice],
) -> dict[str, Any]:
    """Entries of an observation in the order of their space; those that ``once`` lacks are columns of the state."""
    whole: dict[str, Any] = {}
    for key, part in space.spaces.items():
        below = {path[1:]: cols for path, cols in columns.items() if path[0] == key}
        if () in below:
            whole[key] = state[below[()]]
        elif isinstance(part, spaces.Dict) and below:
            whole[key] = _in_order(part, once.get(key, {}), state, below)
        else:
            whole[key] = once[key]
    return whole
