"""Habits of Gymnasium before 1.0 and of machines with a GPU, for which MS-HAB's scripts were written."""

from __future__ import annotations

from typing import Any

import gymnasium
import torch
from gymnasium import vector

from mjhab.compat.mshab.wrappers.forwarding import ForwardingWrapper
from mjhab.core.errors import warn_once


def keep_old_habits() -> None:
    """Let wrappers pass on attributes that they lack, and vector wrappers have their former name."""
    if not hasattr(vector, "VectorEnvWrapper"):
        vector.VectorEnvWrapper = vector.VectorWrapper  # type: ignore[attr-defined]
    # Gymnasium before 1.0 has it, and its own stays.
    if not hasattr(gymnasium.Wrapper, "__getattr__"):
        gymnasium.Wrapper.__getattr__ = ForwardingWrapper.__getattr__  # type: ignore[attr-defined]


def stay_on_the_cpu() -> None:
    """Where there is no GPU, let ``tensor.cuda()`` give the tensor itself; some scripts ask for no other device."""
    if not torch.cuda.is_available():
        torch.Tensor.cuda = _stays  # type: ignore[method-assign]


def _stays(self: torch.Tensor, *_: Any, **__: Any) -> torch.Tensor:
    warn_once("tensor.cuda(): there is no GPU, so tensors stay on the CPU.")
    return self
