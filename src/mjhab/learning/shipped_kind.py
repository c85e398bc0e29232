"""Checkpoints that come with the package: ``--policy student`` of every command. See `evaluation.resolve.PolicyModule`.

`evaluation.resolve.full_spec` adds the subtask to "student", for instance ``student:set_table/close/fridge/top_door``.
Without a subtask the students of a task's subtasks act in turn.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

from mjhab.core.errors import UsageError, unknown_name
from mjhab.evaluation.resolve import STUDENT, PolicyFacts, PolicyOptions
from mjhab.learning import policy_kind
from mjhab.learning.by_subtask import Entry, build_entries, describe_entries
from mjhab.learning.checkpoint import load_checkpoint
from mjhab.rollout.policy import Policy, RolloutEnv

FOLDER = Path(__file__).parent / "shipped"
"""Folder of checkpoints (`student.safetensors` of runs), named ``TASK.SUBTASK.TARGET.safetensors`` with "-" for "/", or
``TASK.SUBTASK.safetensors`` of a student for all targets."""
SUFFIX = ".safetensors"


def shipped() -> dict[str, Path]:
    """The package's checkpoints by file name without the extension."""
    return {path.name.removesuffix(SUFFIX): path for path in sorted(FOLDER.glob(f"*{SUFFIX}"))}


def shipped_path(task: str, subtask: str, target: str) -> Path:
    """The checkpoint for a subtask on a target: one for this target alone, else one for all.

    Raises:
        UsageError: there is none; the message lists the existing ones.
    """
    there = shipped()
    for name in (file_name(task, subtask, target), file_name(task, subtask, "")):
        if name in there:
            return there[name]
    if not target:
        raise UsageError(
            f"give --target, or another subtask. The package has students for: {_listed()}; train others with "
            "`mjhab train`."
        )
    raise unknown_name("student of this package", file_name(task, subtask, target), there)


def shipped_entries(task: str) -> tuple[Entry, ...]:
    """The checkpoints for the subtasks of a task.

    Raises:
        UsageError: there is none; the message lists the existing ones.
    """
    entries = []
    for name, path in shipped().items():
        if name.startswith(f"{task}."):
            scene = load_checkpoint(path).about["scene"]
            entries.append(Entry(scene["subtask"], scene["target"], path))
    if not entries:
        raise UsageError(
            f"the package has no student for the task {task!r}, but for: {_listed()}; train others with `mjhab train`."
        )
    return tuple(entries)


def _listed() -> str:
    return ", ".join(shipped()) or "nothing"


def _parts(spec: str) -> tuple[str, str, str]:
    """Task, subtask and target of ``student:TASK/SUBTASK/TARGET``; empty where they are not given."""
    task, _, rest = spec.removeprefix(STUDENT).removeprefix(":").partition("/")
    subtask, _, target = rest.partition("/")
    return task, subtask, target


def file_name(task: str, subtask: str, target: str) -> str:
    """File name of a student without the extension; ``target`` is "" of a student for all targets."""
    parts = (task, subtask, re.sub(r"[^\w-]", "-", target))
    return ".".join(part for part in parts if part)


def inspect_policy(spec: str) -> PolicyFacts:
    """Describe a student of the package, or those of a task together, see `policy_kind.inspect_policy`."""
    task, subtask, target = _parts(spec)
    if not subtask:
        return describe_entries(STUDENT, shipped_entries(task))
    facts = policy_kind.inspect_policy(str(shipped_path(task, subtask, target)))
    return dataclasses.replace(facts, name=STUDENT)


def build_policy(spec: str, env: RolloutEnv, options: PolicyOptions) -> Policy:
    """Build a student of the package, or those of a task together, see `policy_kind.build_policy`."""
    task, subtask, target = _parts(spec)
    if not subtask:
        return build_entries(STUDENT, shipped_entries(task), env, options)
    return policy_kind.build_policy(str(shipped_path(task, subtask, target)), env, options)
