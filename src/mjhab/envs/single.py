"""One world as a plain `gymnasium.Env`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.core.errors import UsageError
from mjhab.envs.parts.observing import ObservedRows
from mjhab.envs.spaces import action_space, keyed_space
from mjhab.robots.controllers import make_controller
from mjhab.robots.registry import robot_named

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv


class SingleEnv(gymnasium.Env):
    """A vector environment of one world without its leading axis. ``gymnasium.make(id)`` gives one.

    Observations, actions and info are those of the vector environment at world 0. An episode ends by termination or
    truncation; then ``reset`` begins the next one, or the first one of a new ``seed``.

    The world is built when it is first used. Until then the environment is its configuration and can be copied and
    pickled, as asynchronous vector environments and samplers in other processes need it.

    Args:
        config: of one world on backend "cpu", without autoreset.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - gymnasium wants a plain dict

    def __init__(self, config: EnvConfig) -> None:
        self.config = config
        self._opened: SequentialTaskEnv | None = None
        robot = robot_named(config.robot)
        rows = ObservedRows(robot, config.obs_mode, config.cameras, config.camera_size)
        controller = make_controller(
            config.control_mode, robot=robot, base=config.base, stationary=config.stationary
        )
        self.observation_space = keyed_space(rows.single_space, config)
        self.action_space = action_space(controller)
        self.render_mode = config.render_mode or None

    @property
    def worlds(self) -> SequentialTaskEnv:
        """The vector environment behind it, built on first use."""
        if self._opened is None:
            from mjhab.envs.sequential import SequentialTaskEnv

            self._opened = SequentialTaskEnv(self.config)
        return self._opened

    def __getattr__(self, name: str) -> Any:
        # Called for what Env lacks: action_table, taint_names, get_state and so on are those of the worlds.
        if name.startswith("_") or name == "worlds":
            raise AttributeError(name)
        return getattr(self.worlds, name)

    def __getstate__(self) -> dict[str, Any]:
        if self._opened is not None:
            raise UsageError(
                "an environment that was used can be neither copied nor pickled; do it before the first reset, "
                "or move its state by get_state and set_state."
            )
        return self.__dict__

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict, dict]:
        """Begin an episode; see `SequentialTaskEnv.reset` for the options."""
        super().reset(seed=seed)
        obs, info = self.worlds.reset(seed=seed, options=options)
        return _first(obs), _first(info)

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        """One control step of 50 ms under ``action`` (A,).

        Raises:
            UsageError: wrong shape or type, or ``reset`` was not called.
        """
        obs, reward, terminated, truncated, info = self.worlds.step(np.asarray(action)[None])
        return _first(obs), float(reward[0]), bool(terminated[0]), bool(truncated[0]), _first(info)

    def render(self) -> np.ndarray | None:
        """Human view (H, W, 3) uint8, or None without a render mode."""
        return self.worlds.render_world(0) if self.render_mode else None

    def close(self) -> None:
        """Close the worlds; closing twice is fine."""
        if self._opened is not None:
            self._opened.close()


def _first(value: Any) -> Any:
    """World 0 of a nested dict of arrays (W, ...)."""
    if isinstance(value, dict):
        return {key: _first(entry) for key, entry in value.items()}
    return value[0]
