"""Checkpoints that come with the package: ``--policy learned`` of every command. See `evaluation.resolve.OpenedPolicy`.

`evaluation.resolve.full_spec` adds the subtask to "learned", for instance ``learned:set_table/close/fridge/top_door``.
Without a subtask the students of a task's subtasks act in turn; where the robot is not teleported and the task has no
student of Navigate, the expert drives. "learned:NAME" is the checkpoint of that name, whatever is to be done: one that
reads the sentence; or the policies of a file of that name, one for each subtask.
"""

from __future__ import annotations

import dataclasses
import re
from functools import cached_property
from pathlib import Path
from typing import Any, cast

from mjhab.core.errors import unknown_name
from mjhab.core.files.reading import read_json_object
from mjhab.evaluation.resolve import (
    EXPERT,
    POLICIES_SUFFIX,
    NoPolicyError,
    OpenedPolicy,
    PolicyFacts,
    PolicyOptions,
    Wanted,
    open_policy,
)
from mjhab.learning.assigned.entries import Entry, trained_for
from mjhab.learning.by_subtask import PoliciesFile, PoliciesTogether
from mjhab.learning.policy_kind import AND, CHECKPOINT_SUFFIX, CheckpointFiles
from mjhab.learning.require import require_learn
from mjhab.rollout.policy import Policy, RolloutEnv
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import SUBTASKS

FOLDER = Path(__file__).parent / "shipped"
"""Folder of checkpoints (`student.safetensors` of runs), named ``TASK.SUBTASK.TARGET.safetensors`` with "-" for "/", or
``TASK.SUBTASK.safetensors`` of a student for all targets; one that reads the sentence has a name of its own."""
INDEX = "index.json"
"""File beside them: for a name that several checkpoints act for, or one that acts for other names too, their names."""


def shipped() -> dict[str, str]:
    """The package's checkpoints by name, see `FOLDER`; several that act together are joined as in `policy_kind`."""
    index = FOLDER / INDEX
    together = read_json_object(index) if index.is_file() else {}
    listed = {member for members in together.values() for member in members}
    alone = {
        path.name.removesuffix(CHECKPOINT_SUFFIX)
        for path in FOLDER.glob(f"*{CHECKPOINT_SUFFIX}")
        # A member of several acts with the others, not alone.
    } - listed
    return {
        name: AND.join(
            str(FOLDER / f"{member}{CHECKPOINT_SUFFIX}")
            for member in together.get(name, [name])
        )
        for name in sorted(alone | set(together))
    }


def policy_files() -> dict[str, Path]:
    """The package's files of policies by name, see `by_subtask.PoliciesFile`: those for homes of another pack."""
    found = sorted(FOLDER.glob(f"*{POLICIES_SUFFIX}"))
    return {path.stem: path for path in found if path.name != INDEX}


def shipped_path(task: str, subtask: str, target: str) -> str:
    """The checkpoint for a subtask on a target: one for this target alone, else one for all.

    Raises:
        UsageError: a name is unknown.
        NoPolicyError: there is no such student; the message lists the existing ones.
    """
    objects = TASKS[task].object_types
    kind = SUBTASKS[subtask]
    if target and objects and not kind.jointed and target not in objects:
        raise unknown_name("target", target, objects)
    there = shipped()
    # The student for this very target first: it knows more of it.
    for name in (file_name(task, subtask, target), file_name(task, subtask, "")):
        if name in there:
            return there[name]
    if not target:
        raise NoPolicyError(
            f"give --target, or another subtask. The package has students for: {_listed()}; train others with "
            "`mjhab train`."
        )
    name = file_name(task, subtask, target)
    said = unknown_name("student of this package", name, there)
    raise NoPolicyError(str(said), option=said.option, given=name, expected=said.expected)


def _listed() -> str:
    return ", ".join([*shipped(), *policy_files()]) or "nothing"


def file_name(task: str, subtask: str, target: str) -> str:
    """File name of a student without the extension; ``target`` is "" of a student for all targets."""
    # A slash would be a folder.
    parts = (task, subtask, re.sub(r"[^\w-]", "-", target))
    return ".".join(part for part in parts if part)


class ShippedTask(PoliciesTogether):
    """The package's students of a task together.

    Args:
        spec: their name.
        task: the task.
    """

    def __init__(self, spec: str, task: str) -> None:
        super().__init__(spec)
        self._task = task

    @cached_property
    def opened(self) -> list[OpenedPolicy]:
        """The checkpoints for the subtasks of the task.

        Raises:
            UsageError: there is none; the message lists the existing ones.
        """
        require_learn()
        named = [name for name in shipped() if name.startswith(f"{self._task}.")]
        if not named:
            raise NoPolicyError(
                f"the package has no student for the task {self._task!r}, but for: {_listed()}; train others with "
                "`mjhab train`."
            )
        return [CheckpointFiles(shipped()[name]) for name in named]

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """What they act for."""
        named = [name for name in shipped() if name.startswith(f"{self._task}.")]
        entries = []
        for name, opened in zip(named, self.opened, strict=True):
            assert isinstance(opened, CheckpointFiles)
            trained = trained_for(opened.paths[0], opened.content[0].about)
            # A student may have been trained for more than its file is named for.
            done = next(one for one in trained if file_name(**vars(one)) == name)
            entries.append(Entry(done.subtask, done.target, opened.spec))
        return tuple(entries)

    @property
    def takes_style(self) -> bool:
        """Whether the expert may drive."""
        return bool(self._driven)

    @property
    def _driven(self) -> list[str]:
        """Subtasks that drive and no student has learned."""
        learned = {entry.subtask for entry in self.entries}
        subtasks = TASKS[self._task].subtasks
        return [s for s in subtasks if SUBTASKS[s].navigates and s not in learned]

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        """Build them; where the robot is not teleported, the expert drives if no student does."""
        if cast(Any, env).config.navigate != "teleport":
            driven = self._driven
            entries = (*self.entries, *(Entry(name, "", EXPERT) for name in driven))
            opened = [*self.opened, *(open_policy(EXPERT) for _ in driven)]
            return self.together(entries, opened, env, options)
        return super()._build(env, options)


class ShippedPolicy(OpenedPolicy):
    """A student of the package, or those of a task together."""

    @property
    def _name(self) -> str:
        """The name that was used, so that runs under the old one can go on."""
        head, _, tail = self.spec.partition(":")
        return self.spec if tail in {*shipped(), *policy_files()} else head

    @cached_property
    def _found(self) -> OpenedPolicy:
        told = self.spec.partition(":")[2]
        # A name of its own comes before task and subtask.
        if told in shipped():
            return CheckpointFiles(shipped()[told])
        if told in policy_files():
            return PoliciesFile(str(policy_files()[told]))
        wanted = Wanted.parse(told)
        if not wanted.subtask:
            return ShippedTask(self._name, wanted.task)
        return CheckpointFiles(shipped_path(wanted.task, wanted.subtask, wanted.target))

    @property
    def takes_style(self) -> bool:
        """See `OpenedPolicy.takes_style`."""
        return self._found.takes_style

    @property
    def facts(self) -> PolicyFacts:
        """Those of what was found, by the name of students of the package."""
        return dataclasses.replace(self._found.facts, name=self._name)

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        return self._found._build(env, options)
