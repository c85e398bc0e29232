"""mjhab in LeRobot: ``lerobot-eval --env.type=mjhab --env.task=set_table --env.subtask=pick ...``.

LeRobot imports this package by its name; importing it registers the environment.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs import utils
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from mjhab.integrations.lerobot import FPS, LeRobotEnv


def _world(options: dict[str, Any]) -> gymnasium.Env:
    """One world; from LeRobot 0.6.1 on it is not simulated on after its episode while others of its batch are."""
    world = LeRobotEnv(**options)
    frozen = getattr(utils, "FreezeAfterEpisodeEnd", None)
    return world if frozen is None else frozen(world)


@EnvConfig.register_subclass("mjhab")
@dataclass
class MjhabEnvConfig(EnvConfig):
    """Options of `mjhab.integrations.lerobot.LeRobotEnv`."""

    task: str | None = "set_table"
    fps: int = FPS
    subtask: str = "pick"
    target: str = ""
    split: str = "val"
    actions: str = "joint"
    image_size: int = 128
    seed: int = 0
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        from mjhab.envs.observations.state import state_dim, unsensed_dim
        from mjhab.evaluation.served.action_spaces import ActionReader, space_named
        from mjhab.robots.controllers import make_controller
        from mjhab.robots.registry import robot_named

        robot = robot_named()
        table = make_controller(space_named(self.actions).control_mode).table
        width = len(ActionReader(self.actions, table).names)
        shape = (self.image_size, self.image_size, 3)
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(width,)),
            "agent_pos": PolicyFeature(
                type=FeatureType.STATE, shape=(state_dim(robot, own=True),)
            ),
            "environment_state": PolicyFeature(
                type=FeatureType.ENV, shape=(unsensed_dim(robot),)
            ),
        }
        self.features_map = {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "environment_state": OBS_ENV_STATE,
        }
        for camera in robot.camera_names:
            key = f"pixels/{camera}"
            self.features[key] = PolicyFeature(type=FeatureType.VISUAL, shape=shape)
            self.features_map[key] = f"{OBS_IMAGES}.{camera}"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Options of one environment."""
        return {
            "task": self.task or "set_table",
            "subtask": self.subtask,
            "target": self.target,
            "split": self.split,
            "actions": self.actions,
            "camera_size": self.image_size,
            "seed": self.seed,
        }

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
        """``n_envs`` worlds side by side, in processes of their own with ``use_async_envs``."""
        makers = [partial(_world, self.gym_kwargs)] * n_envs
        mode = gymnasium.vector.AutoresetMode.SAME_STEP
        if use_async_envs and n_envs > 1:
            worlds: Any = gymnasium.vector.AsyncVectorEnv(
                makers, autoreset_mode=mode, context="forkserver"
            )
        else:
            worlds = gymnasium.vector.SyncVectorEnv(makers, autoreset_mode=mode)
        return {"mjhab": {0: worlds}}
