"""Environment ids, and the one place that builds environments."""

from __future__ import annotations

from typing import Any

import gymnasium

from mjhab.core.errors import unknown_name
from mjhab.envs.config import EnvConfig

ENV_IDS = {
    "mjhab/TidyHouse-v1": {"task": "tidy_house"},
    "mjhab/PrepareGroceries-v1": {"task": "prepare_groceries"},
    "mjhab/SetTable-v1": {"task": "set_table"},
}
"""Gymnasium ids of the long-horizon tasks and the configuration each stands for."""


def make(**options: Any) -> Any:
    """Build a SequentialTask environment.

    Args:
        **options: fields of `EnvConfig`.

    Raises:
        UsageError: unknown option or value; the message lists the valid ones.
    """
    from mjhab.envs.sequential import SequentialTaskEnv

    known = EnvConfig.__dataclass_fields__
    for name in options:
        if name not in known:
            raise unknown_name("environment option", name, known)
    return SequentialTaskEnv(EnvConfig(**options))


def make_by_id(env_id: str, **options: Any) -> Any:
    """Build the environment of a Gymnasium id, e.g. ``"mjhab/SetTable-v1"``."""
    if env_id not in ENV_IDS:
        raise unknown_name("environment id", env_id, ENV_IDS)
    return make(**{**ENV_IDS[env_id], **options})


def register_envs() -> None:
    """Make the ids known to ``gymnasium.make_vec``; called when ``mjhab.envs`` is imported."""
    for env_id, options in ENV_IDS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(env_id, vector_entry_point=make, kwargs=dict(options))
