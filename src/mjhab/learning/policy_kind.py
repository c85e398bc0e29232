"""Checkpoints as policies: ``--policy CHECKPOINT.safetensors`` of every command.

See `evaluation.resolve.PolicyModule`.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from mjhab.core.errors import UsageError
from mjhab.evaluation.resolve import PolicyFacts, PolicyOptions
from mjhab.learning.require import require_learn
from mjhab.rollout.policy import Policy, RolloutEnv


def inspect_policy(spec: str) -> PolicyFacts:
    """Describe a checkpoint: its name, the hash of its bytes, and the options of the environment that it needs.

    Raises:
        UsageError: torch is not installed, or the file cannot be read.
    """
    require_learn()
    from mjhab.learning.checkpoint import load_checkpoint

    path = Path(spec)
    options = load_checkpoint(path).layout.env_options()
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return PolicyFacts(path.stem, {"policy_sha256": digest}, options)


def build_policy(spec: str, env: RolloutEnv, options: PolicyOptions) -> Policy:
    """Build the policy of a checkpoint.

    Raises:
        UsageError: as `inspect_policy`; the environment shows or takes something else than the student knows; or a
            style was asked for.
    """
    if options.style:
        raise UsageError(f"a style is for the policy expert; {spec} has none.")
    require_learn()
    from mjhab.learning.checkpoint import load_student
    from mjhab.learning.policy import StudentPolicy

    return StudentPolicy(load_student(Path(spec)), env, options.seed)
