"""The predefined policies expert, random and zero. See `resolve.PolicyModule`."""

from __future__ import annotations

from typing import Any, cast

from mjhab.evaluation.resolve import PolicyFacts, PolicyOptions, check_style
from mjhab.rollout.policy import Policy, RandomPolicy, RolloutEnv, ZeroPolicy
from mjhab.tasks.style import Styles


def inspect_policy(spec: str) -> PolicyFacts:
    """Describe the policy; its name and the version of mjhab identify it."""
    return PolicyFacts(spec, reads_instruction=False)


def build_policy(spec: str, env: RolloutEnv, options: PolicyOptions) -> Policy:
    """Build the policy.

    Raises:
        UsageError: ``options`` sets a style for a policy without one, or the expert cannot act in this environment.
    """
    check_style(spec, options.style)
    worlds = cast(Any, env)
    if spec == "zero":
        return ZeroPolicy(len(worlds.action_table))
    if spec == "random":
        return RandomPolicy(options.seed, len(worlds.action_table))
    from mjhab.experts import make_expert

    # Experts read privileged state, which only mjhab's environments provide.
    return make_expert(worlds, Styles.parse(options.style) if options.style else None)
