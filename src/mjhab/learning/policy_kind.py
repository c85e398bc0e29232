"""Checkpoints as policies: ``--policy CHECKPOINT.safetensors`` of every command.

``A.safetensors+B.safetensors`` names several that act together, see `policy.StudentEnsemble`. See
`evaluation.resolve.OpenedPolicy`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from mjhab.core.errors import UsageError, wrong_value
from mjhab.core.files.reading import is_file
from mjhab.evaluation.resolve import (
    OpenedPolicy,
    PolicyFacts,
    PolicyOptions,
    no_instruction,
)
from mjhab.learning.require import require_learn
from mjhab.rollout.policy import Policy, RolloutEnv
from mjhab.tasks.instructions import telling_words, vocabulary

if TYPE_CHECKING:
    from mjhab.envs.parts.worlds import PolicyWorlds
    from mjhab.learning.checkpoint import Checkpoint

AND = "+"
CHECKPOINT_SUFFIX = ".safetensors"
CAMERA_SIZE_OPTION = "camera_size"
OBS_MODE = "obs_mode"


def members(spec: str) -> list[Path]:
    """Files of the checkpoints that a specification names."""
    # A file may have "+" in its name.
    if is_file(Path(spec)):
        return [Path(spec)]
    *first, last = spec.split(f"{CHECKPOINT_SUFFIX}{AND}")
    return [*(Path(part + CHECKPOINT_SUFFIX) for part in first), Path(last)]


def joined(name: str, needed: Iterable[tuple[str, Mapping[str, Any]]]) -> dict[str, Any]:
    """Options of an environment in which several students can act: all of their images, in the largest size.

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
            if option == OBS_MODE:
                # Each looks at its own images.
                modes = [*str(kept).split("+"), *str(value).split("+")]
                options[option] = "+".join(dict.fromkeys(modes))
                continue
            square = isinstance(kept, int) and isinstance(value, int)
            if (
                option == CAMERA_SIZE_OPTION
                and square
                # The smaller images are means of whole blocks of the larger ones.
                and max(kept, value) % min(kept, value) == 0
            ):
                options[option] = max(kept, value)
            else:
                raise UsageError(
                    f"the policies of {name} need different environments: {option} is {kept!r} for one and {value!r} "
                    f"for {member}."
                )
    return options


class CheckpointFiles(OpenedPolicy):
    """A checkpoint, or several together. Their content is kept: for the description and for the policy."""

    @cached_property
    def paths(self) -> list[Path]:
        """The files."""
        return members(self.spec)

    @cached_property
    def content(self) -> list[Checkpoint]:
        """What they hold.

        Raises:
            UsageError: torch is not installed, or a file cannot be read.
        """
        require_learn()
        from mjhab.learning.checkpoint import load_checkpoint

        return [load_checkpoint(path) for path in self.paths]

    @cached_property
    def facts(self) -> PolicyFacts:
        """Name, hash of the bytes, profile, and the environment that is needed.

        The run's records hold the checkpoint's profile as ``policy_profile`` and the environment's as ``profile``.

        Raises:
            UsageError: see `content`; or the students need different environments.
        """
        layouts = [checkpoint.layout for checkpoint in self.content]
        digests = [hashlib.sha256(path.read_bytes()).hexdigest() for path in self.paths]
        digest = digests[0]
        if len(digests) > 1:
            # In the order given, although the mean does not depend on it: its last bits do.
            digest = hashlib.sha256("".join(digests).encode()).hexdigest()
        options = (layout.env_options() for layout in layouts)
        return PolicyFacts(
            AND.join(path.stem for path in self.paths),
            {"policy_sha256": digest, "policy_profile": layouts[0].profile},
            joined(self.spec, zip(map(str, self.paths), options, strict=True)),
            layouts[0].robot_name,
            any(layout.inputs.sentence for layout in layouts),
            self._caution(),
        )

    def _caution(self) -> str:
        """What to warn of: networks that were never updated."""
        pairs = zip(self.paths, self.content, strict=True)
        random = [str(path) for path, checkpoint in pairs if checkpoint.is_untrained]
        if not random:
            return ""
        return (
            f"{', '.join(random)} has random weights: it was never trained (0 updates)."
        )

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        """Build the policy.

        Raises:
            UsageError: see `content`; the environment's observations or actions do not match the student's; or
                ``options`` has an instruction for students without sentences.
        """
        pairs = zip(self.paths, self.content, strict=True)
        from mjhab.learning.checkpoint import student_of
        from mjhab.learning.policy import StudentEnsemble, StudentPolicy

        acting = cast("PolicyWorlds", env)
        students = [student_of(path, checkpoint) for path, checkpoint in pairs]
        if options.instruction and not any(
            student.config.inputs.sentence for student in students
        ):
            raise no_instruction(self.spec)
        if options.instruction:
            _check_language(options.instruction, acting)
        several = len(students) > 1
        policies = [
            StudentPolicy(
                student,
                acting,
                options.seed,
                student.layout.pool_in(acting) if options.pools or several else 1,
                options.instruction,
            )
            for student in students
        ]
        return StudentEnsemble(policies) if several else policies[0]


def _check_language(sentence: str, worlds: PolicyWorlds) -> None:
    """Refuse a sentence none of whose words a policy can have learned here.

    Raises:
        UsageError: it is in another language, say.
    """
    known = vocabulary([*worlds.layout.roster, *worlds.layout.link_ids])
    if not telling_words(sentence) & known:
        raise wrong_value(
            "instruction",
            sentence,
            "a sentence with words that episodes are told by, such as 'open the fridge'",
            f"Known are, among others, {', '.join(sorted(known)[:12])}.",
        )
