"""Checkpoints that come with the package: ``--policy learned`` of every command. See `evaluation.resolve.OpenedPolicy`.

`evaluation.resolve.full_spec` adds the subtask to "learned", for instance ``learned:set_table/close/fridge/top_door``.
Without a subtask the students of a task's subtasks act in turn; where the robot is not teleported and the task has no
student of Navigate, the expert drives.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, cast

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.files.reading import read_json_object
from mjhab.evaluation.resolve import (
    EXPERT,
    OpenedPolicy,
    PolicyFacts,
    PolicyOptions,
    open_policy,
)
from mjhab.learning.by_subtask import Entry, PoliciesTogether
from mjhab.learning.policy_kind import AND, CHECKPOINT_SUFFIX, CheckpointFiles
from mjhab.learning.require import require_learn
from mjhab.rollout.policy import Policy, RolloutEnv
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import SUBTASKS

FOLDER = Path(__file__).parent / "shipped"
"""Folder of checkpoints (`student.safetensors` of runs), named ``TASK.SUBTASK.TARGET.safetensors`` with "-" for "/", or
``TASK.SUBTASK.safetensors`` of a student for all targets."""
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
    } - listed
    return {
        name: AND.join(
            str(FOLDER / f"{member}{CHECKPOINT_SUFFIX}")
            for member in together.get(name, [name])
        )
        for name in sorted(alone | set(together))
    }


def shipped_path(task: str, subtask: str, target: str) -> str:
    """The checkpoint for a subtask on a target: one for this target alone, else one for all.

    Raises:
        UsageError: a name is unknown, or there is no such student; the message lists the existing ones.
    """
    objects = TASKS[task].object_types
    kind = SUBTASKS[subtask]
    if target and objects and not kind.jointed and target not in objects:
        raise unknown_name("target", target, objects)
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


def scenes_of(about: Mapping[str, Any]) -> list[dict[str, str]]:
    """Task, subtask and target of everything that a checkpoint was trained for, from what its file says."""
    return [
        {key: scene[key] for key in ("task", "subtask", "target")}
        for scene in (about["scene"], *about.get("also", ()))
    ]


def _listed() -> str:
    return ", ".join(shipped()) or "nothing"


def _parts(spec: str) -> tuple[str, str, str]:
    """Task, subtask and target of ``learned:TASK/SUBTASK/TARGET``; empty where they are not given."""
    task, _, rest = spec.partition(":")[2].partition("/")
    subtask, _, target = rest.partition("/")
    return task, subtask, target


def file_name(task: str, subtask: str, target: str) -> str:
    """File name of a student without the extension; ``target`` is "" of a student for all targets."""
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
            raise UsageError(
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
            metadata = opened.content[0].about
            scene = next(one for one in scenes_of(metadata) if file_name(**one) == name)
            entries.append(Entry(scene["subtask"], scene["target"], opened.spec))
        return tuple(entries)

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        """Build them; where the robot is not teleported, the expert drives if no student does."""
        if cast(Any, env).config.navigate != "teleport":
            learned = {entry.subtask for entry in self.entries}
            driving = [
                name
                for name in TASKS[self._task].subtasks
                if SUBTASKS[name].navigates and name not in learned
            ]
            entries = (*self.entries, *(Entry(name, "", EXPERT) for name in driving))
            opened = [*self.opened, *(open_policy(EXPERT) for _ in driving)]
            return self.together(entries, opened, env, options)
        return super()._build(env, options)


class ShippedPolicy(OpenedPolicy):
    """A student of the package, or those of a task together."""

    @property
    def _name(self) -> str:
        """The name that was used, so that runs under the old one can go on."""
        return self.spec.partition(":")[0]

    @cached_property
    def _found(self) -> OpenedPolicy:
        task, subtask, target = _parts(self.spec)
        if not subtask:
            return ShippedTask(self._name, task)
        return CheckpointFiles(shipped_path(task, subtask, target))

    @property
    def facts(self) -> PolicyFacts:
        """Those of what was found, by the name of students of the package."""
        return dataclasses.replace(self._found.facts, name=self._name)

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        return self._found._build(env, options)
