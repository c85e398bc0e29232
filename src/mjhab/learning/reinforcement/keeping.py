"""Optimizers as named tensors, for checkpoints that are not pickles."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Everything an optimizer remembers, by "number of the parameter/name"."""
    found: dict[str, Tensor] = {}
    for number, state in optimizer.state_dict()["state"].items():
        for name, value in state.items():
            found[f"{number}/{name}"] = torch.as_tensor(value)
    return found


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Take over what ``optimizer_tensors`` gave."""
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        number, _, name = key.partition("/")
        state.setdefault(int(number), {})[name] = value
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})


def prefixed(part: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors with "part/" before their names."""
    return {f"{part}/{name}": value for name, value in tensors.items()}


def part_of(part: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What ``prefixed`` made of a part."""
    before = f"{part}/"
    return {
        name.removeprefix(before): value
        for name, value in tensors.items()
        if name.startswith(before)
    }
