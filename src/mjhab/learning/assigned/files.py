"""Files and folders of policies, and their entries.

A file is ``{"policies": [{"subtask": "pick", "target": "024_bowl", "checkpoint": "pick.safetensors"}, ...]}``; its
paths are relative to its folder. In place of a checkpoint an entry may name any other policy, as for ``--policy``:
``"expert"``, ``"ms_hab:pick.pt"``, ``"mine.py:Mine"``. An entry with the target "" applies to all targets without an
entry of their own, and one with a "task" to this task alone.

A folder holds checkpoints, or runs of ``mjhab train``. Each checkpoint says what it was trained for.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mjhab.core.errors import UsageError, fault
from mjhab.core.files.reading import beside, is_file, read_json_object
from mjhab.core.typed.options import read_record
from mjhab.evaluation.resolve import (
    LEARNED,
    LEARNED_NAMES,
    MS_HAB_PREFIX,
    NAMED_POLICIES,
    POLICIES_SUFFIX,
)
from mjhab.learning import policy_kind
from mjhab.learning.assigned.entries import Entry, check_apart, trained_for
from mjhab.learning.require import require_learn
from mjhab.learning.runs.run import STUDENT, TRAINING
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import SUBTASKS

WITHOUT_FILE = (*(f"{name}:" for name in LEARNED_NAMES), "ws://", "wss://")
"""Beginnings of specifications that name no file."""
_FIELDS = ("subtask", "target", "checkpoint")


def read_entries(path: Path) -> tuple[Entry, ...]:
    """Read a policies file.

    Raises:
        UsageError: the file does not exist or has another format, a name is unknown, or two entries name one.
    """
    if not is_file(path):
        raise fault(
            path,
            "does not exist; give a JSON file that names one checkpoint per subtask.",
        )
    try:
        rows = read_record(
            tuple[Entry, ...], read_json_object(path).get("policies"), "policies"
        )
        entries = tuple(
            replace(row, checkpoint=_beside(path, row.checkpoint)) for row in rows
        )
    except ValueError as error:
        raise fault(
            path, f'must hold {{"policies": [{{{", ".join(_FIELDS)}}}, ...]}}. {error}'
        ) from error
    for entry in entries:
        SUBTASKS.check(entry.subtask)
        if entry.task:
            TASKS.check(entry.task)
    check_apart(str(path), entries)
    return entries


def _beside(path: Path, spec: str) -> str:
    """The specification of an entry, with its files below the folder of the policies file.

    Raises:
        UsageError: it is another policies file, or a student of the package without what it does.
        ValueError: it names a file that cannot be.
    """
    if spec in LEARNED_NAMES:
        raise fault(path, f"say which policy: {LEARNED}:TASK/SUBTASK/TARGET.")
    # Files that name each other would have no end.
    if spec.endswith(POLICIES_SUFFIX):
        raise fault(
            path, f"an entry names one policy, not another policies file ({spec})."
        )
    if spec in NAMED_POLICIES or spec.startswith(WITHOUT_FILE):
        return spec
    # This prefix is followed by a file; the others of `WITHOUT_FILE` are not.
    prefix = MS_HAB_PREFIX if spec.startswith(MS_HAB_PREFIX) else ""
    files = policy_kind.members(spec.removeprefix(prefix))
    return prefix + policy_kind.AND.join(str(beside(path, str(file))) for file in files)


def entries_text(path: Path, entries: Sequence[Entry]) -> str:
    """Text of a policies file at ``path``; the checkpoints must lie below its folder."""
    rows = [
        {
            "subtask": entry.subtask,
            "target": entry.target,
            "checkpoint": policy_kind.AND.join(
                str(member.relative_to(path.parent))
                for member in policy_kind.members(entry.checkpoint)
            ),
            **({"task": entry.task} if entry.task else {}),
        }
        for entry in entries
    ]
    return json.dumps({"policies": rows}, indent=1) + "\n"


def entries_in(folder: Path) -> tuple[Entry, ...]:
    """What the checkpoints of a folder and of the training runs in it were trained for.

    Raises:
        UsageError: there is none, one cannot be read or does not tell, or torch is not installed.
    """
    require_learn()
    from mjhab.learning.checkpoint import load_checkpoint

    suffix = policy_kind.CHECKPOINT_SUFFIX
    # One level down only: deeper lie the checkpoints of single rounds.
    found = [*folder.glob(f"*{suffix}"), *folder.glob(f"*/{STUDENT}")]
    # A run's own folder has the state of its training, too.
    paths = sorted(path for path in found if path.name != TRAINING)
    if not paths:
        raise UsageError(
            f"there is no policy in the folder {folder}: neither *{suffix} nor runs of `mjhab train` (*/{STUDENT}).",
            option="policy",
            given=str(folder),
        )
    return tuple(
        Entry(done.subtask, done.target, str(path), done.task)
        for path in paths
        for done in trained_for(path, load_checkpoint(path).about)
    )
