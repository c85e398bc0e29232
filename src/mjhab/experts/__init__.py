"""Scripted whole-body experts that act only through the 13-D action."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv
    from mjhab.experts.policy import ExpertPolicy


def make_expert(env: SequentialTaskEnv) -> ExpertPolicy:
    """The expert policy of an environment (one script per world, restarted with every subtask)."""
    from mjhab.experts.policy import ExpertPolicy

    return ExpertPolicy(env)
