"""mjhab as LeRobot sees environments; the package lerobot_env_mjhab registers it there. Needs no lerobot."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

import mjhab.envs as envs
from mjhab.core.errors import UsageError
from mjhab.envs.observations.modes import camera_key, image_size
from mjhab.envs.observations.state import state_dim, unsensed_dim
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.evaluation.served.action_spaces import ActionReader, space_named
from mjhab.evaluation.served.own_state import split_state

FPS = 20
MAX_SUBTASK_STEPS = 500
MAX_CHAIN_STEPS = 8000
"""Bounds [control steps] that no episode reaches: the environment ends each at its own horizon."""


class LeRobotEnv(gymnasium.Env):
    """One world with the observations, attributes and info that LeRobot's evaluation reads.

    Observations: ``pixels`` with the images of the robot's cameras by name, (H, W, 3) uint8;
    ``agent_pos`` (34,), what the robot's own sensors tell; ``environment_state`` (11,), what only the simulation knows
    (object, goal, grasp). In exported data sets they are ``observation.state`` and ``observation.environment_state``,
    the images ``observation.images.NAME``, and actions those of the space "joint": a policy that was trained on an
    export needs no renaming. ``info``: ``is_success``, whether the episode succeeded so far. ``task_description`` is
    the instruction of the active subtask.

    Args:
        actions: an action space of `evaluation.served.action_spaces`.
        **options: fields of `config.env.EnvConfig`, Pick in homes of val by default; ``subtask`` "" is the whole task.
            ``profile`` is that of the exported data, so that axes of objects and joint angles are told as there.
            ``seed`` is that of the episodes; the seed that a reset is given is the index of its episode.

    Raises:
        UsageError: an unknown name among the options.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": ["rgb_array"],
        "render_fps": FPS,
    }  # type: ignore[misc]

    def __init__(self, actions: str = "joint", **options: Any) -> None:
        self.render_mode = "rgb_array"
        self._env: SequentialTaskEnv = envs.make(
            **{"subtask": "pick", "split": "val", **options},
            num_envs=1,
            threads=1,
            obs_mode="rgb",
            control_mode=space_named(actions).control_mode,
            autoreset="disabled",
        )
        config = self._env.config
        robot = self._env.layout.robot
        self._reader = ActionReader(actions, self._env.action_table)
        self._index = -1
        self._success = False
        self._max_episode_steps = MAX_SUBTASK_STEPS if config.subtask else MAX_CHAIN_STEPS
        self.task_description = ""
        self.task = f"{config.task} {config.subtask}".strip()
        shape = (*image_size(config.camera_size), 3)
        image = spaces.Box(0, 255, shape, np.uint8)
        self.observation_space = spaces.Dict(
            {
                "pixels": spaces.Dict(dict.fromkeys(robot.camera_names, image)),
                "agent_pos": _box(state_dim(robot, own=True)),
                "environment_state": _box(unsensed_dim(robot)),
            }
        )
        self.action_space = spaces.Box(
            -np.inf, np.inf, (len(self._reader.names),), np.float32
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin the episode whose index is ``seed``; the next one without a seed."""
        super().reset(seed=seed)
        # LeRobot numbers its episodes by seeds.
        self._index = self._index + 1 if seed is None else seed
        chosen = {"episode": np.array([self._index]), "reset_mask": np.ones(1, bool)}
        # The seed of the environment stays, so that indices name the episodes of `mjhab eval`.
        obs, info = self._env.reset(seed=self._env.config.seed, options=chosen)
        self._success = False
        return self._converted(obs, info)

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One control step of 50 ms.

        Raises:
            UsageError: another number of values than the action space has, or numbers that are not finite.
        """
        sent = np.asarray(action, np.float32).reshape(1, -1)
        problem = self._reader.problem(sent)
        if problem:
            raise UsageError(problem)
        obs, reward, terminated, truncated, info = self._env.step(self._reader.read(sent))
        # LeRobot looks at the last step only, and success may come before it.
        self._success |= bool(info["success"][0])
        seen, about = self._converted(obs, info)
        return seen, float(reward[0]), bool(terminated[0]), bool(truncated[0]), about

    def render(self) -> np.ndarray:
        """A view over the robot's shoulder, (H, W, 3) uint8."""
        return self._env.render_world(0)

    def close(self) -> None:
        """Close the world."""
        self._env.close()

    def _converted(self, obs: Any, info: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        self.task_description = info["instruction"][0]
        images = {
            camera: obs[camera_key(camera, "rgb")][0]
            for camera in self._env.layout.robot.camera_names
        }
        own, unsensed = split_state(self._env)
        seen = {
            "pixels": images,
            "agent_pos": own[0],
            "environment_state": unsensed[0],
        }
        return seen, {"is_success": self._success}


def _box(width: int) -> spaces.Box:
    """The space of so many numbers."""
    return spaces.Box(-np.inf, np.inf, (width,), np.float32)
