"""The predefined policies expert, random and zero. See `resolve.OpenedPolicy`."""

from __future__ import annotations

from typing import Any, cast

from mjhab.evaluation.resolve import (
    OpenedPolicy,
    PolicyFacts,
    PolicyOptions,
    check_style,
)
from mjhab.rollout.policy import Policy, RandomPolicy, RolloutEnv, ZeroPolicy
from mjhab.tasks.style import Styles


class NamedPolicy(OpenedPolicy):
    """One of them; its name and the version of mjhab identify it."""

    @property
    def facts(self) -> PolicyFacts:
        """Its name."""
        return PolicyFacts(self.spec, reads_instruction=False)

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        """Build the policy.

        Raises:
            UsageError: ``options`` sets a style for a policy without one, or the expert cannot act in this environment.
        """
        check_style(self.spec, options.style)
        worlds = cast(Any, env)
        if self.spec == "zero":
            return ZeroPolicy(len(worlds.action_table))
        if self.spec == "random":
            return RandomPolicy(options.seed, len(worlds.action_table))
        from mjhab.experts import make_expert

        # Experts read privileged state, which only mjhab's environments provide.
        return make_expert(worlds, Styles.parse(options.style) if options.style else None)
