"""Checkpoints as policies: ``--policy CHECKPOINT.safetensors`` of every command.

``A.safetensors+B.safetensors`` names several that act together, see `policy.StudentEnsemble`. See
`evaluation.resolve.PolicyModule`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from mjhab.core.errors import UsageError
from mjhab.core.files.reading import is_file
from mjhab.evaluation.resolve import PolicyFacts, PolicyOptions, no_instruction
from mjhab.learning.require import require_learn
from mjhab.rollout.policy import Policy, RolloutEnv

if TYPE_CHECKING:
    from mjhab.learning.checkpoint import Checkpoint
    from mjhab.learning.layout import ActingEnv

AND = "+"
SUFFIX = ".safetensors"
CAMERA_SIZE = "camera_size"


def members(spec: str) -> list[Path]:
    """Files of the checkpoints that a specification names."""
    if is_file(Path(spec)):
        return [Path(spec)]
    *first, last = spec.split(f"{SUFFIX}{AND}")
    return [*(Path(part + SUFFIX) for part in first), Path(last)]


def joined(name: str, needed: Iterable[tuple[str, Mapping[str, Any]]]) -> dict[str, Any]:
    """Options of an environment in which several students can act: the largest of their image sizes.

    Args:
        name: of them together, for the error.
        needed: name and options of each.

    Raises:
        UsageError: they need different environments.
    """
    options: dict[str, Any] = {}
    for member, wanted in needed:
        for option, value in wanted.items():
            kept = options.setdefault(option, value)
            if kept == value:
                continue
            square = isinstance(kept, int) and isinstance(value, int)
            if (
                option == CAMERA_SIZE
                and square
                and max(kept, value) % min(kept, value) == 0
            ):
                options[option] = max(kept, value)
            else:
                raise UsageError(
                    f"the policies of {name} need different environments: {option} is {kept!r} for one and {value!r} "
                    f"for {member}."
                )
    return options


def inspect_policy(spec: str) -> PolicyFacts:
    """Describe a checkpoint, or several: name, hash of the bytes, profile, and the environment that is needed.

    The run's records hold the checkpoint's profile as ``policy_profile`` and the environment's as ``profile``.

    Raises:
        UsageError: torch is not installed, a file cannot be read, or the students need different environments.
    """
    require_learn()
    from mjhab.learning.checkpoint import load_checkpoint

    paths = members(spec)
    checkpoints = [load_checkpoint(path) for path in paths]
    layouts = [checkpoint.layout for checkpoint in checkpoints]
    reads = any(layout.inputs.sentence for layout in layouts)
    digests = [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths]
    digest = digests[0]
    if len(digests) > 1:
        digest = hashlib.sha256("".join(digests).encode()).hexdigest()
    named = zip(
        map(str, paths), (layout.env_options() for layout in layouts), strict=True
    )
    identity = {"policy_sha256": digest, "policy_profile": layouts[0].profile}
    name = AND.join(path.stem for path in paths)
    return PolicyFacts(
        name,
        identity,
        joined(spec, named),
        layouts[0].robot_name,
        reads,
        _caution(paths, checkpoints),
    )


def _caution(paths: Sequence[Path], checkpoints: Sequence[Checkpoint]) -> str:
    """What to warn of: networks that were never updated."""
    pairs = zip(paths, checkpoints, strict=True)
    random = [str(path) for path, checkpoint in pairs if checkpoint.is_untrained]
    if not random:
        return ""
    return f"{', '.join(random)} has random weights: it was never trained (0 updates)."


def build_policy(
    spec: str, env: RolloutEnv, options: PolicyOptions, pools: bool = False
) -> Policy:
    """Build the policy of a checkpoint, or that of several together.

    Args:
        spec: the files.
        env: the environment.
        options: of the run.
        pools: whether images may be larger than those that a student was trained with, as they may with several.

    Raises:
        UsageError: as `inspect_policy`; the environment's observations or actions do not match the student's; or
            ``options`` sets a style, or an instruction for students without sentences.
    """
    if options.style:
        raise UsageError(f"only the policy expert has a style; {spec} has none.")
    require_learn()
    from mjhab.learning.checkpoint import load_student
    from mjhab.learning.policy import StudentEnsemble, StudentPolicy

    acting = cast("ActingEnv", env)
    students = [load_student(path) for path in members(spec)]
    if options.instruction and not any(
        student.config.inputs.sentence for student in students
    ):
        raise no_instruction(spec)
    several = len(students) > 1
    policies = [
        StudentPolicy(
            student,
            acting,
            options.seed,
            student.layout.pool_in(acting) if pools or several else 1,
            options.instruction,
        )
        for student in students
    ]
    return StudentEnsemble(policies) if several else policies[0]
