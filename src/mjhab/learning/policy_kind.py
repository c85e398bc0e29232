"""Checkpoints as policies: ``--policy CHECKPOINT.safetensors`` of every command.

See `evaluation.resolve.PolicyModule`.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, cast

from mjhab.core.errors import UsageError
from mjhab.evaluation.resolve import PolicyFacts, PolicyOptions
from mjhab.learning.require import require_learn
from mjhab.rollout.policy import Policy, RolloutEnv

if TYPE_CHECKING:
    from mjhab.learning.layout import ActingEnv


def inspect_policy(spec: str) -> PolicyFacts:
    """Describe a checkpoint: its name, the hash of its bytes, its profile, and the environment that it needs.

    In an environment of another profile the record of a run has both: ``policy_profile`` and ``profile``.

    Raises:
        UsageError: torch is not installed, or the file cannot be read.
    """
    require_learn()
    from mjhab.learning.checkpoint import load_checkpoint

    path = Path(spec)
    layout = load_checkpoint(path).layout
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    identity = {"policy_sha256": digest, "policy_profile": layout.profile}
    return PolicyFacts(path.stem, identity, layout.env_options())


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

    return StudentPolicy(load_student(Path(spec)), cast("ActingEnv", env), options.seed)
