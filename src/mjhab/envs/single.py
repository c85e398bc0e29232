"""One world as a plain `gymnasium.Env`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from mjhab.config.env import EnvConfig
from mjhab.core.errors import UsageError
from mjhab.envs.episode_length import with_episode_length
from mjhab.envs.parts.observing import ObservedRows
from mjhab.envs.spaces import action_space, keyed_space
from mjhab.robots.controllers import make_controller
from mjhab.robots.registry import robot_named

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv

OF_WORLDS = frozenset(
    """
    action_table adopt boxes controller count ctrl episode_spec episodes_now fail fallback focus follow
    get_columns get_state goal_distance grip homes info joint_start layout link_state make_episode nan_resets nav
    observer outcome_signals perturber progress render_world render_worlds reporter restorable_parts reward_terms
    rewarder seeds sensing set_columns set_state signals sim source starts state state_as state_digest success
    tables taint_names task_config teleports timed_methods tracker view wordings
    """.split()
)
"""Attributes of `SingleEnv.worlds` that `SingleEnv` forwards. Attributes that only vector environments have in
Gymnasium, such as ``num_envs``, are not forwarded, because other libraries recognise vector environments by them."""


class SingleEnv(gymnasium.Env):
    """One world as a plain Gymnasium environment, without a leading axis of worlds; ``gymnasium.make(id)`` makes one.

    Observations, actions and info are those of world 0 of the vector environment `worlds`; bools in info are arrays of
    shape (). The attributes OF_WORLDS, such as ``action_table``, are forwarded to the vector environment unchanged. An
    episode ends by termination or truncation; ``reset`` then begins the next one, or the first one of a new ``seed``.

    The world is built on first use. Until then the environment holds only its configuration and can be copied and
    pickled, which asynchronous vector environments and samplers in other processes require.

    Args:
        config: options of one world on backend "cpu", with autoreset "disabled".
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - gymnasium wants a plain dict

    def __init__(self, config: EnvConfig) -> None:
        self.config = config
        self._spec: EnvSpec | None = None
        self._opened: SequentialTaskEnv | None = None
        robot = robot_named(config.robot)
        rows = ObservedRows(robot, config.obs_mode, config.cameras, config.camera_size)
        controller = make_controller(
            config.control_mode,
            robot=robot,
            base=config.base,
            stationary=config.stationary,
        )
        self.observation_space = keyed_space(rows.single_space, config)
        self.action_space = action_space(controller)
        self.render_mode = config.render_mode or None

    @property
    def spec(self) -> EnvSpec | None:
        """What ``gymnasium.make`` made it of, with ``max_episode_steps``; None without it."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = with_episode_length(spec, self.config)

    @property
    def worlds(self) -> SequentialTaskEnv:
        """The vector environment of one world, built on first use."""
        # Spaces are known without a simulator, and some callers ask for nothing else.
        if self._opened is None:
            from mjhab.envs.sequential import SequentialTaskEnv

            self._opened = SequentialTaskEnv(self.config)
        return self._opened

    def __getattr__(self, name: str) -> Any:
        # Only for attributes that Env lacks. An unknown name must not build the world, e.g. in `hasattr`.
        if name in OF_WORLDS:
            return getattr(self.worlds, name)
        raise AttributeError(
            f"{type(self).__name__!r} has no attribute {name!r}; its vector environment is `worlds`",
            name=name,
            obj=self,
        )

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
        # Gymnasium's own generator begins from the seed, too, for wrappers that draw from it.
        super().reset(seed=seed)
        obs, info = self.worlds.reset(seed=seed, options=options)
        return _first(obs), _first(info)

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        """One control step of 50 ms under ``action`` (A,).

        Raises:
            UsageError: wrong shape or type, or ``reset`` was not called.
        """
        obs, reward, terminated, truncated, info = self.worlds.step(
            np.asarray(action)[None]
        )
        return (
            _first(obs),
            float(reward[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            _first(info),
        )

    def observe(self) -> dict[str, Any]:
        """The observation of the present state, for instance after `set_state`, which returns none.

        Raises:
            UsageError: ``reset`` was never called.
        """
        return _first(self.worlds.observe())

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
    first = value[0]
    # An array () instead of numpy's bool, which Gymnasium's wrappers take for an object of unknown type.
    return np.asarray(first) if isinstance(first, np.bool_) else first
