"""One world as a plain `gymnasium.Env`."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from mjhab.envs.sequential import SequentialTaskEnv


class SingleEnv(gymnasium.Env):
    """A vector environment of one world without its leading axis. ``gymnasium.make(id)`` gives one.

    Observations, actions and info are those of the vector environment at world 0. An episode ends by termination or
    truncation; then ``reset`` begins the next one, or the first one of a new ``seed``.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - gymnasium wants a plain dict

    def __init__(self, worlds: SequentialTaskEnv) -> None:
        self.worlds = worlds
        """The vector environment behind it."""
        self.observation_space = worlds.single_observation_space
        self.action_space = worlds.single_action_space
        self.render_mode = worlds.config.render_mode or None

    def __getattr__(self, name: str) -> Any:
        # Called for what Env lacks: action_table, taint_names, get_state and so on are those of the worlds.
        if name.startswith("_") or name == "worlds":
            raise AttributeError(name)
        return getattr(self.worlds, name)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict, dict]:
        """Begin an episode; see `SequentialTaskEnv.reset` for the options."""
        super().reset(seed=seed)
        obs, info = self.worlds.reset(seed=seed, options=options)
        return _first(obs), _first(info)

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        """One control step of 50 ms under ``action`` (A,)."""
        obs, reward, terminated, truncated, info = self.worlds.step(np.asarray(action)[None])
        return _first(obs), float(reward[0]), bool(terminated[0]), bool(truncated[0]), _first(info)

    def render(self) -> np.ndarray | None:
        """Human view (H, W, 3) uint8, or None without a render mode."""
        return self.worlds.render_world(0) if self.render_mode else None

    def close(self) -> None:
        """Close the worlds; closing twice is fine."""
        self.worlds.close()


def _first(value: Any) -> Any:
    """World 0 of a nested dict of arrays and lists."""
    if isinstance(value, dict):
        return {key: _first(entry) for key, entry in value.items()}
    return value[0]
