"""Habits of Gymnasium before 1.0, for which MS-HAB's scripts were written, for the time of one script."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium import vector


def keep_old_habits() -> None:
    """Let wrappers pass on attributes that they lack, and vector wrappers have their former name."""
    if not hasattr(vector, "VectorEnvWrapper"):
        vector.VectorEnvWrapper = vector.VectorWrapper  # type: ignore[attr-defined]
    if not hasattr(gymnasium.Wrapper, "__getattr__"):
        gymnasium.Wrapper.__getattr__ = _below  # type: ignore[attr-defined]


def _below(self: Any, name: str) -> Any:
    if name.startswith("_") or name == "env":
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
    return getattr(self.env, name)
