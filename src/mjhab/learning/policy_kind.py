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

    The run's records hold the checkpoint's profile as ``policy_profile`` and the environment's as ``profile``.

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
        UsageError: as `inspect_policy`; the environment's observations or actions do not match the student's; or
            ``options`` sets a style.
    """
    if options.style:
        raise UsageError(f"only the policy expert has a style; {spec} has none.")
    require_learn()
    from mjhab.learning.checkpoint import load_student
    from mjhab.learning.policy import StudentPolicy

    return StudentPolicy(load_student(Path(spec)), cast("ActingEnv", env), options.seed)
