"""Environments: configurations, episodes, spawns, actions, observations, SequentialTask, SubtaskTrain, env ids."""

from mjhab.config.env import EnvConfig, TrainConfig
from mjhab.envs.catalog import ENV_IDS, make, make_by_id, make_train, register_envs

register_envs()

__all__ = ["ENV_IDS", "EnvConfig", "TrainConfig", "make", "make_by_id", "make_train"]
