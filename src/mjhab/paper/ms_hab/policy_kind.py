"""MS-HAB checkpoints as policies: ``--policy ms_hab:CHECKPOINT.pt``. See `evaluation.resolve.OpenedPolicy`."""

from __future__ import annotations

import hashlib
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, cast

from mjhab.core.errors import wrong_value
from mjhab.evaluation.resolve import (
    MS_HAB_PREFIX,
    OpenedPolicy,
    PolicyFacts,
    PolicyOptions,
)
from mjhab.learning.require import require_learn
from mjhab.rollout.policy import Policy, RolloutEnv

if TYPE_CHECKING:
    from mjhab.envs.parts.worlds import PolicyWorlds
    from mjhab.paper.ms_hab.network import Network


class MsHabFile(OpenedPolicy):
    """A checkpoint of MS-HAB."""

    @cached_property
    def network(self) -> tuple[str, Network]:
        """Name and network, see `ms_hab.checkpoint.load_network`."""
        require_learn()
        from mjhab.paper.ms_hab.checkpoint import load_network

        return load_network(_path_of(self.spec))

    @property
    def facts(self) -> PolicyFacts:
        """Its name, the hash of its bytes, and the options of the environment that it needs.

        They include MS-HAB's profile; options of the user take precedence.

        Raises:
            UsageError: torch is not installed, or the file cannot be read as a policy of MS-HAB.
        """
        # A file that is no checkpoint shall be refused as such, before it is hashed.
        _ = self.network
        from mjhab.paper.ms_hab.policy import ENV_OPTIONS

        path = _path_of(self.spec)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        return PolicyFacts(
            f"ms_hab-{path.stem}",
            {"policy_sha256": digest},
            ENV_OPTIONS,
            reads_instruction=False,
        )

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        """Build the policy.

        Raises:
            UsageError: as `facts`; the environment lacks observations that the policy needs.
        """
        require_learn()
        from mjhab.paper.ms_hab.policy import check_environment, policy_of

        acting = cast("PolicyWorlds", env)
        check_environment(acting.config)
        return policy_of(*self.network, acting)


def _path_of(spec: str) -> Path:
    path = spec.removeprefix(MS_HAB_PREFIX)
    if not path:
        raise wrong_value(
            "policy", spec, f"a checkpoint of MS-HAB, as in {MS_HAB_PREFIX}CHECKPOINT.pt"
        )
    return Path(path)
