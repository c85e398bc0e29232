"""Checkpoints that come with the package: ``--policy student`` of every command. See `evaluation.resolve.PolicyModule`.

`evaluation.resolve.full_spec` adds the subtask to "student", for instance ``student:set_table/close/fridge/top_door``.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

from mjhab.core.errors import UsageError, unknown_name
from mjhab.evaluation.resolve import STUDENT, PolicyFacts, PolicyOptions
from mjhab.learning import policy_kind
from mjhab.rollout.policy import Policy, RolloutEnv

FOLDER = Path(__file__).parent / "shipped"
"""Folder of checkpoints (`student.safetensors` of runs), named ``TASK.SUBTASK.TARGET.safetensors`` with "-" for "/"."""
SUFFIX = ".safetensors"


def shipped() -> dict[str, Path]:
    """The package's checkpoints by file name without the extension."""
    return {path.name.removesuffix(SUFFIX): path for path in sorted(FOLDER.glob(f"*{SUFFIX}"))}


def shipped_path(spec: str) -> Path:
    """The checkpoint for ``student:TASK/SUBTASK/TARGET``.

    Raises:
        UsageError: there is none; the message lists the existing ones.
    """
    what = spec.removeprefix(STUDENT).removeprefix(":")
    task, _, rest = what.partition("/")
    subtask, _, target = rest.partition("/")
    there = shipped()
    if not (task and subtask and target):
        raise UsageError(
            f"the policy {STUDENT} executes one subtask on one target: give --task, --subtask and --target. The "
            f"package has students for: {', '.join(there) or 'nothing'}; train others with `mjhab train`."
        )
    name = file_name(task, subtask, target)
    if name not in there:
        raise unknown_name("student of this package", name, there)
    return there[name]


def file_name(task: str, subtask: str, target: str) -> str:
    """File name of a student without the extension."""
    return ".".join((task, subtask, re.sub(r"[^\w-]", "-", target)))


def inspect_policy(spec: str) -> PolicyFacts:
    """Describe a student of the package, see `policy_kind.inspect_policy`."""
    facts = policy_kind.inspect_policy(str(shipped_path(spec)))
    return dataclasses.replace(facts, name=STUDENT)


def build_policy(spec: str, env: RolloutEnv, options: PolicyOptions) -> Policy:
    """Build a student of the package, see `policy_kind.build_policy`."""
    return policy_kind.build_policy(str(shipped_path(spec)), env, options)
