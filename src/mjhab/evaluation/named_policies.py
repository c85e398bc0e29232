"""The predefined policies expert, random and zero. See `resolve.OpenedPolicy`."""

from __future__ import annotations

from typing import Any, cast

from mjhab.evaluation.resolve import (
    EXPERT,
    OpenedPolicy,
    PolicyFacts,
    PolicyOptions,
)
from mjhab.rollout.policy import Policy, RandomPolicy, RolloutEnv, ZeroPolicy
from mjhab.tasks.style import Styles


class NamedPolicy(OpenedPolicy):
    """One of them; its name and the version of mjhab identify it."""

    @property
    def facts(self) -> PolicyFacts:
        """Its name."""
        return PolicyFacts(self.spec, reads_instruction=False)

    @property
    def takes_style(self) -> bool:
        """The expert does."""
        return self.spec == EXPERT

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        """Build the policy.

        Raises:
            UsageError: the expert cannot act in this environment.
        """
        worlds = cast(Any, env)
        if self.spec == "zero":
            return ZeroPolicy(len(worlds.action_table))
        if self.spec == "random":
            return RandomPolicy(options.seed, len(worlds.action_table))
        from mjhab.experts import make_expert

        # Experts read privileged state, which only mjhab's environments provide.
        return make_expert(worlds, Styles.parse(options.style) if options.style else None)
