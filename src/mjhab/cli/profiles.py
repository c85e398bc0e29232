"""What ``--profile``, ``--robot``, ``--starts`` and ``--stillness`` make of the environments that a command builds."""

from __future__ import annotations

from typing import Any

from mjhab.cli.options.common import ProfileOptions


def profile_options(options: ProfileOptions) -> dict[str, Any]:
    """What `mjhab.envs.make` and `make_train` are told of the profile, and of what is given beside it."""
    given = {
        "profile": options.profile or None,
        "robot": options.robot,
        "spawn_rule": options.starts,
        "stillness": options.stillness,
    }
    return {name: value for name, value in given.items() if value is not None}


def resolved_profile(options: ProfileOptions, **more: Any) -> dict[str, Any]:
    """The profile's name and the values in force of the options that depend on it, for the record of a run.

    Args:
        more: the other options of the environment that decide about them: ``task``, ``subtask``, ``cameras``, and the
            ``profile`` of the policy, if none is given.

    Raises:
        UsageError: unknown profile or value, or one that contradicts the profile.
    """
    from mjhab.config.env import EnvConfig

    return EnvConfig(**{**more, **profile_options(options)}).of_profile()
