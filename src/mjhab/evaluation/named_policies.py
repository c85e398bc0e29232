"""The policies that have a name: expert, random and zero. See `resolve.PolicyModule`."""

from __future__ import annotations

from typing import Any, cast

from mjhab.core.errors import UsageError
from mjhab.evaluation.resolve import PolicyFacts, PolicyOptions
from mjhab.rollout.policy import Policy, RandomPolicy, RolloutEnv, ZeroPolicy
from mjhab.tasks.style import Styles


def inspect_policy(spec: str) -> PolicyFacts:
    """Name the policy; it is told from others by its name and by the version of mjhab."""
    return PolicyFacts(spec)


def build_policy(spec: str, env: RolloutEnv, options: PolicyOptions) -> Policy:
    """Build the policy.

    Raises:
        UsageError: a style for a policy that has none, or an environment with other actions than the expert's.
    """
    if spec != "expert" and options.style:
        raise UsageError(f"a style is for the policy expert; {spec} has none.")
    if spec == "zero":
        return ZeroPolicy()
    if spec == "random":
        return RandomPolicy(options.seed)
    from mjhab.experts import make_expert

    # Experts read privileged state, which only the environments of mjhab have.
    return make_expert(cast(Any, env), Styles.parse(options.style) if options.style else None)
