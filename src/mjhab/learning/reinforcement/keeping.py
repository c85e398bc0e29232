"""Optimizer state as named tensors, so that checkpoints need no pickle."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """The optimizer's state tensors by "<parameter number>/<name of the state>"."""
    found: dict[str, Tensor] = {}
    for number, state in optimizer.state_dict()["state"].items():
        for name, value in state.items():
            # Step counts are numbers in some optimizers and tensors in others.
            found[f"{number}/{name}"] = torch.as_tensor(value)
    return found


def restore_optimizer(
    optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]
) -> None:
    """Load the tensors that ``optimizer_tensors`` returned into an optimizer.

    Raises:
        ValueError: they are those of other parameters.
    """
    parameters = [value for group in optimizer.param_groups for value in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        number, _, name = key.partition("/")
        entry = int(number)
        # `load_state_dict` takes any shape, and fails at the first step.
        if not 0 <= entry < len(parameters) or (
            value.ndim and value.shape != parameters[entry].shape
        ):
            raise ValueError(
                f"the state {key!r} of an optimizer fits none of its parameters"
            )
        state.setdefault(entry, {})[name] = value
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
