"""Scripted whole-body experts that act only through the 13-D action."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjhab.core.errors import UsageError

if TYPE_CHECKING:
    from mjhab.envs.parts.worlds import Worlds
    from mjhab.experts.policy import ExpertPolicy
    from mjhab.tasks.style import Styles


def make_expert(env: Worlds, styles: Styles | None = None) -> ExpertPolicy:
    """The expert policy of an environment (one script per world, restarted with every subtask).

    Args:
        styles: what every episode draws its style from; the expert as it is if not given.

    Raises:
        UsageError: the environment takes other actions than those experts give.
    """
    from mjhab.experts.policy import ExpertPolicy
    from mjhab.robots.controllers import DEFAULT_MODE

    config = env.config
    # Experts leave the head where it is.
    free = set(config.stationary) <= {"head"}
    if (config.control_mode, config.base) != (DEFAULT_MODE, "forward") or not free:
        raise UsageError(
            f"experts act by control_mode {DEFAULT_MODE!r} with base 'forward' and nothing stationary but the head; "
            f"this environment has {config.control_mode!r}, base {config.base!r}, stationary {config.stationary!r}."
        )

    return ExpertPolicy(env, styles)
