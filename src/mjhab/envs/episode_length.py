"""How long an episode lasts at most, and Gymnasium's specification that says so."""

from __future__ import annotations

import dataclasses

from gymnasium.envs.registration import EnvSpec

from mjhab.config.env import EnvConfig
from mjhab.config.thresholds import task_config
from mjhab.robots.registry import robot_named
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import limits_of


def longest_episode(config: EnvConfig) -> int:
    """Control steps after which every episode has ended: the horizons of its subtasks together."""
    limits = task_config(config, robot_named(config.robot))
    kinds = (config.subtask,) if config.subtask else TASKS[config.task].kinds
    # Whole numbers, for which the built-in sum is the same everywhere.
    return sum(limits_of(limits, kind).horizon for kind in kinds)


def with_episode_length(spec: EnvSpec | None, config: EnvConfig) -> EnvSpec | None:
    """A specification with ``max_episode_steps`` of an environment.

    Registered ids have none: it depends on the options, and Gymnasium would cut episodes after it (TimeLimit).
    """
    if spec is None:
        return None
    return dataclasses.replace(spec, max_episode_steps=longest_episode(config))
