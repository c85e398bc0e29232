"""Scripted experts that control base, torso and arm through the same action vector as a learned policy."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjhab.core.errors import UsageError, shown

if TYPE_CHECKING:
    from mjhab.envs.parts.worlds import PolicyWorlds
    from mjhab.experts.policy import ExpertPolicy
    from mjhab.tasks.style import Styles


def make_expert(env: PolicyWorlds, styles: Styles | None = None) -> ExpertPolicy:
    """Make the expert policy of an environment: one script per world, restarted with every subtask.

    Args:
        env: batch of worlds that the expert acts in.
        styles: distribution from which every episode draws its style; without it the experts act in the plain style.

    Raises:
        UsageError: it is no such environment, or experts cannot act in its control mode, base mode or with its
            stationary parts; or ``styles`` is of another type.
    """
    from mjhab.envs.sequential import SequentialTaskEnv
    from mjhab.experts.policy import ExpertPolicy
    from mjhab.robots.controllers import DEFAULT_MODE
    from mjhab.tasks.style import Styles

    if not isinstance(env, SequentialTaskEnv):
        raise UsageError(
            "make_expert takes the vector environment of mjhab.make or mjhab.make_train on backend 'cpu' (of a "
            f"wrapper, env.unwrapped; of one world, env.unwrapped.worlds), not {shown(env)}."
        )
    if styles is not None and not isinstance(styles, Styles):
        raise UsageError(
            "make_expert takes styles as mjhab.tasks.style.Styles, for instance "
            f'Styles.parse(["speed=0.5..1.0"]), not {shown(styles)}.'
        )
    config = env.config
    # The head may be stationary: no subtask needs it to move.
    free = set(config.stationary) <= {"head"}
    if (config.control_mode, config.base) != (DEFAULT_MODE, "forward") or not free:
        raise UsageError(
            f"experts act by control_mode {DEFAULT_MODE!r} with base 'forward' and nothing stationary but the head; "
            f"this environment has {config.control_mode!r}, base {config.base!r}, stationary {config.stationary!r}."
        )

    return ExpertPolicy(env, styles)
