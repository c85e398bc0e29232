"""MS-HAB checkpoints as policies: ``--policy ms_hab:CHECKPOINT.pt``. See `evaluation.resolve.PolicyModule`."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import cast

from mjhab.core.errors import UsageError
from mjhab.evaluation.resolve import MS_HAB_PREFIX, PolicyFacts, PolicyOptions
from mjhab.learning.require import require_learn
from mjhab.rollout.policy import Policy, RolloutEnv


def inspect_policy(spec: str) -> PolicyFacts:
    """Describe a checkpoint: its name, the hash of its bytes, and the options of the environment that it needs.

    They include MS-HAB's profile; options of the user take precedence.

    Raises:
        UsageError: torch is not installed, or the file cannot be read as a policy of MS-HAB.
    """
    require_learn()
    from mjhab.paper.ms_hab.checkpoint import load_network
    from mjhab.paper.ms_hab.policy import ENV_OPTIONS

    path = _path_of(spec)
    load_network(path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return PolicyFacts(
        f"ms_hab-{path.stem}",
        {"policy_sha256": digest},
        ENV_OPTIONS,
        reads_instruction=False,
    )


def build_policy(spec: str, env: RolloutEnv, options: PolicyOptions) -> Policy:
    """Build the policy of a checkpoint.

    Raises:
        UsageError: as `inspect_policy`; the environment lacks observations that the policy needs; or ``options`` sets a
            style.
    """
    if options.style:
        raise UsageError(f"only the policy expert has a style; {spec} has none.")
    require_learn()
    from mjhab.paper.ms_hab.policy import Environment, ms_hab_policy

    return ms_hab_policy(_path_of(spec), cast(Environment, env))


def _path_of(spec: str) -> Path:
    path = spec.removeprefix(MS_HAB_PREFIX)
    if not path:
        raise UsageError(
            f"policy {spec!r} names no file; give a checkpoint of MS-HAB, as in {MS_HAB_PREFIX}CHECKPOINT.pt"
        )
    return Path(path)
