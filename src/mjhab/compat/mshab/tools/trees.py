"""Nested dicts of tensors and arrays, under the names of ``mani_skill.utils.common``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from mjhab.core.errors import wrong_type


def mapped(function: Callable[[Any], Any], tree: Any) -> Any:
    """The tree with every leaf replaced; a leaf alone is one, too."""
    if isinstance(tree, Mapping):
        return {key: mapped(function, value) for key, value in tree.items()}
    return function(tree)


def torch_clone_dict(data: Any) -> Any:
    """A copy whose tensors share no memory with those of ``data``; other leaves are shared."""
    return mapped(lambda x: x.clone() if isinstance(x, torch.Tensor) else x, data)


def to_tensor(array: Any, device: Any = None) -> Any:
    """Every leaf as a tensor on ``device`` (default: the CPU, where a tensor stays where it is)."""

    def converted(values: Any) -> torch.Tensor:
        if isinstance(values, np.ndarray) and values.dtype == np.uint16:
            # torch can compute little with it.
            values = values.astype(np.int32)
        if isinstance(values, list | tuple) and len(values) and _holds_arrays(values):
            values = (
                torch.stack(list(values))
                if isinstance(values[0], torch.Tensor)
                else np.asarray(values)
            )
        found = torch.as_tensor(values)
        # As in ManiSkill: scripts give these to networks of float32.
        if found.dtype == torch.float64:
            found = found.float()
        return found if device is None else found.to(device)

    return mapped(converted, array)


def _holds_arrays(values: Any) -> bool:
    return isinstance(values[0], torch.Tensor | np.ndarray)


def to_cpu_tensor(array: Any) -> Any:
    """Every leaf as a tensor on the CPU."""
    return to_tensor(array, "cpu")


def to_numpy(array: Any, dtype: Any = None) -> Any:
    """Every leaf as an array; texts, numbers and truth values as they are."""

    def converted(values: Any) -> Any:
        if isinstance(values, torch.Tensor):
            values = values.detach().cpu().numpy()
        elif isinstance(values, str | bytes | int | float | np.generic) or values is None:
            return values
        else:
            values = np.asarray(values)
        return values if dtype is None else values.astype(dtype)

    return mapped(converted, array)


def batch(*trees: Any) -> Any:
    """Every leaf with a leading dimension of 1; one tree, or a tuple of trees."""

    def longer(values: Any) -> Any:
        if isinstance(values, str):
            return values
        if isinstance(values, torch.Tensor):
            return values[None]
        found = np.asarray(values)
        return found.reshape(1, 1) if found.ndim == 0 else found[None]

    made = tuple(mapped(longer, tree) for tree in trees)
    return made[0] if len(made) == 1 else made


def unbatch(*trees: Any) -> Any:
    """Every leaf without its leading dimension of 1; a number alone as a number. Inverse of `batch`."""

    def shorter(values: Any) -> Any:
        if isinstance(values, torch.Tensor | np.ndarray) and len(values) == 1:
            found = values[0]
            return found.item() if found.ndim == 0 else found
        return values

    made = tuple(mapped(shorter, tree) for tree in trees)
    return made[0] if len(made) == 1 else made


def append_dict_array(x1: Any, x2: Any) -> Any:
    """The rows of ``x2`` behind those of ``x1``, leaf by leaf; dicts of ``x1`` are changed in place.

    Raises:
        UsageError: ``x2`` lacks an entry of ``x1``.
    """
    if isinstance(x1, dict):
        for key in x1:
            if key not in x2:
                raise wrong_type("what is appended", sorted(x2), f"a dict with {key!r}")
            x1[key] = append_dict_array(x1[key], x2[key])
        return x1
    if isinstance(x1, list):
        return x1 + x2
    if isinstance(x1, torch.Tensor):
        return torch.cat([x1, x2])
    if isinstance(x1, np.ndarray):
        missing = x1.ndim - x2.ndim
        at = 1 if x1.ndim > 1 and x1.shape[1] == 1 else 0
        return np.concatenate([x1, np.expand_dims(x2, at) if missing > 0 else x2])
    return x1


def index_dict_array(x1: Any, idx: Any, inplace: bool = True) -> Any:
    """Rows ``idx`` of every leaf; ``inplace``: put into the dicts of ``x1``."""
    if not isinstance(x1, dict):
        return x1[idx]
    found = {key: index_dict_array(value, idx, inplace) for key, value in x1.items()}
    if not inplace:
        return found
    x1.update(found)
    return x1


def flatten_state_dict(
    state_dict: Any, use_torch: bool = False, device: Any = None
) -> Any:
    """The leaves side by side (W, n), in order; a leaf (W,) is one column.

    Raises:
        UsageError: a leaf has more than two dimensions.
    """
    columns: list[torch.Tensor] = []

    def collect(values: Any) -> None:
        found = torch.as_tensor(values)
        if found.ndim > 2:
            raise wrong_type(
                "an entry of the state", tuple(found.shape), "(W,) or (W, n)"
            )
        columns.append(found[:, None] if found.ndim == 1 else found)

    mapped(collect, state_dict)
    flat = torch.hstack(columns) if columns else torch.empty(0, device=device)
    flat = flat if device is None else flat.to(device)
    return flat if use_torch else flat.cpu().numpy()


def flatten_dict_keys(d: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """``{"a": {"b": 1}}`` as ``{"a/b": 1}``."""
    flat: dict[str, Any] = {}
    for key, value in d.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat |= flatten_dict_keys(value, f"{name}/")
        else:
            flat[name] = value
    return flat


def compute_angle_between(x1: torch.Tensor, x2: torch.Tensor) -> torch.Tensor:
    """(n,) angles [rad] between vectors (n, 3)."""
    one = torch.nn.functional.normalize(x1, dim=-1)
    two = torch.nn.functional.normalize(x2, dim=-1)
    # Rounding can leave the range of a cosine, where the angle is NaN.
    return torch.arccos((one * two).sum(-1).clamp(-1, 1))


def normalize_vector(x: torch.Tensor, eps: float = 1e-6) -> torch.Tensor:
    """Vectors (n, 3) with length 1; shorter ones than ``eps`` as 0."""
    length = torch.linalg.norm(x, dim=-1, keepdim=True)
    return torch.where(length < eps, torch.zeros_like(x), x / length.clamp(min=eps))
