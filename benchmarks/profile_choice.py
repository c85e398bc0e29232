"""What ``--profile``, ``--robot``, ``--starts``, ... make of the environments that a command builds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mjhab.config.profiles import DEFAULT_PROFILE


@dataclass(frozen=True, kw_only=True)
class ProfileChoice:
    """A profile, and what is given beside it."""

    profile: str = DEFAULT_PROFILE
    """Values of many options at once: ms_hab is the environment of the MS-HAB paper (see docs/environments.md); "" for
    that of the policy or the data, if they have one."""
    robot: str | None = None
    """The robot (see: mjhab robots list); the default one if absent."""
    starts: str | None = None
    """Start positions of Pick and Place at a drawer or fridge, and start posture of the arm in Place: front_box or
    published (spawn_rule of an environment); the profile's if absent."""
    stillness: str | None = None
    """Whether a joint that moves backwards counts as moving (absolute) or as still (published); the profile's if
    absent."""
    joint_dynamics: str | None = None
    """Damping, friction, stops and range of doors and drawers: ours, or those of their files (published); the profile's
    if absent."""


def profile_options(choice: ProfileChoice) -> dict[str, Any]:
    """What `mjhab.envs.make` and `make_train` are told of the profile, and of what is given beside it."""
    given = {
        "profile": choice.profile or None,
        "robot": choice.robot,
        "spawn_rule": choice.starts,
        "stillness": choice.stillness,
        "joint_dynamics": choice.joint_dynamics,
    }
    return {name: value for name, value in given.items() if value is not None}


def resolved_profile(choice: ProfileChoice, **more: Any) -> dict[str, Any]:
    """The profile's name and the values in force of the options that depend on it, for the record of a run.

    Args:
        more: the other options of the environment that decide about them: ``task``, ``subtask``, ``cameras``, and the
            ``profile`` of the policy, if none is given.

    Raises:
        UsageError: unknown profile or value, or one that contradicts the profile.
    """
    from mjhab.config.env import EnvConfig

    return EnvConfig(**{**more, **profile_options(choice)}).of_profile()
