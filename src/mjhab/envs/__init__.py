"""Environments: configurations, episodes, spawns, actions, observations, SequentialTask, env ids."""

from mjhab.envs.catalog import ENV_IDS, make, make_by_id, register_envs
from mjhab.envs.config import EnvConfig

register_envs()

__all__ = ["ENV_IDS", "EnvConfig", "make", "make_by_id"]
