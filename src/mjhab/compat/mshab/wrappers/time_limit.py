"""The end of an episode by time, for all worlds at once."""

from __future__ import annotations

from typing import Any

import gymnasium
import torch
from gymnasium.wrappers import TimeLimit


class TimeLimitWrapper(gymnasium.Wrapper):
    """Truncates every world after its own number of control steps; takes the place of Gymnasium's `TimeLimit`.

    Args:
        env: an environment of `worlds.env`, perhaps below a `TimeLimit`, whose limit is taken over.
        max_episode_steps: the limit [control steps]; None for that of the `TimeLimit`, or none.
    """

    def __init__(self, env: gymnasium.Env, max_episode_steps: int | None = None) -> None:
        # gymnasium.make may have put its own around, which counts one world only.
        if isinstance(env, TimeLimit):
            if max_episode_steps is None:
                max_episode_steps = env._max_episode_steps
            env = env.env
        super().__init__(env)
        self._max_episode_steps = max_episode_steps

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step; ``truncated`` (W,) bool."""
        obs, reward, terminated, _, info = self.env.step(action)
        elapsed = self.unwrapped.elapsed_steps  # type: ignore[attr-defined]
        limit = self._max_episode_steps
        over = torch.zeros_like(elapsed, dtype=torch.bool)
        if limit is not None:
            over = elapsed >= limit
        return obs, reward, terminated, over, info
