"""What ``--profile``, ``--starts`` and ``--stillness`` make of the environments that a command builds."""

from __future__ import annotations

from typing import Any

from mjhab.cli.options import ProfileOptions

_RECORDED = (
    "profile", "stillness", "spawn_rule", "stationary", "horizon", "force_limits", "reward_formula",
    "reward_normaliser", "cameras", "frame_stack",
)  # fmt: skip
"""Options of an environment that a profile gives values, and its name."""


def profile_options(options: ProfileOptions) -> dict[str, Any]:
    """What `mjhab.envs.make` and `make_train` are told of the profile, and of what is given beside it."""
    given = {"spawn_rule": options.starts, "stillness": options.stillness}
    return {"profile": options.profile} | {name: value for name, value in given.items() if value is not None}


def resolved_profile(options: ProfileOptions, task: str, subtask: str = "") -> dict[str, Any]:
    """The profile's name and the values in force of the options that depend on it, for the record of a run.

    Raises:
        UsageError: unknown profile or value, or one that contradicts the profile.
    """
    from mjhab.envs.config import EnvConfig

    config = EnvConfig(task=task, subtask=subtask, **profile_options(options))
    return {name: getattr(config, name) for name in _RECORDED}
