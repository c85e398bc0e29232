"""Small functions under the names of ``mshab.utils.array``, for scripts without MS-HAB's own package beside them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from mjhab.compat.mshab.tools import trees


def all_equal(array: Sequence[Any]) -> bool:
    """Whether all items are one and the same."""
    return len(set(array)) == 1


def all_same_type(array: Sequence[Any]) -> bool:
    """Whether all items are of one type."""
    return len({type(item) for item in array}) == 1


def recursive_slice(obs: Any, slice: Any, inplace: bool = False) -> Any:
    """Rows of every leaf."""
    return trees.index_dict_array(obs, slice, inplace)


def to_tensor(array: Any, device: Any = None, dtype: Any = torch.float) -> Any:
    """Every leaf as a tensor of a type: one of torch, or "float", "double", "int"."""
    kinds = {"float": torch.float, "double": torch.double, "int": torch.int}
    kind: torch.dtype = kinds[dtype] if isinstance(dtype, str) else dtype

    def converted(values: Any) -> torch.Tensor:
        found = torch.as_tensor(trees.to_tensor(values))
        return found.to(device=device, dtype=kind)

    return trees.mapped(converted, array)


def to_numpy(array: Any, dtype: Any = None) -> Any:
    """Every leaf as an array."""
    return trees.to_numpy(array, np.float64 if dtype is None else dtype)


def recursive_deepcopy(data: Any) -> Any:
    """A copy that shares no numbers."""

    def copied(values: Any) -> Any:
        if isinstance(values, torch.Tensor):
            return values.clone()
        return values.copy() if hasattr(values, "copy") else values

    return trees.mapped(copied, data)
