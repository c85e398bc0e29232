"""Dict spaces that keep the order of their keys; Gymnasium sorts those of a plain dict."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping

from gymnasium import spaces
from gymnasium.vector.utils import batch_space


def ordered_dict(parts: Mapping[str, spaces.Space]) -> spaces.Dict:
    """A Dict space with the keys in the order given."""
    return spaces.Dict(OrderedDict(parts))


def batched(space: spaces.Space, count: int) -> spaces.Space:
    """The space of ``count`` worlds, keys in the order of ``space``."""
    if isinstance(space, spaces.Dict):
        return ordered_dict({key: batched(part, count) for key, part in space.spaces.items()})
    return batch_space(space, count)
