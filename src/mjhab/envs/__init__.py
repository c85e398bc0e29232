"""Gymnasium environments: `make` for tasks and subtasks, `make_train` for training, and the environment ids."""

from mjhab.config.env import EnvConfig, TrainConfig
from mjhab.envs.catalog import env_ids, make, make_by_id, make_train, register_envs

register_envs()

__all__ = ["EnvConfig", "TrainConfig", "env_ids", "make", "make_by_id", "make_train"]
