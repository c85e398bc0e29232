"""Instructions and column names of recorded episodes, for exports and reports."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjhab.data.store.older.schemas import OBJECT_POSE, OLDER_JOINTS
from mjhab.data.store.reading import RecordedEpisode
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.instructions import (
    InstructionRequest,
    Instructions,
    subtask_instruction,
    task_instruction,
    without_teleport_mark,
)
from mjhab.tasks.subtasks.registry import SUBTASKS

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_PARTS: dict[str, tuple[str, ...]] = {
    "extra/tcp_pose_wrt_base": _POSE,
    OBJECT_POSE: _POSE,
    "extra/goal_pos_wrt_base": ("x", "y", "z"),
    "agent/base_vel": ("forward", "left", "yaw"),
}
"""Column names of observations."""
_OF_JOINTS = ("agent/qpos", "agent/qvel")
"""Observations with one column per joint."""


def subtask_words(record: EpisodeRecord) -> list[str]:
    """The instruction of every subtask of an episode; derived from the plan if an old record lacks them."""
    if record.instructions:
        return [without_teleport_mark(sentence) for sentence in record.instructions]
    return [
        subtask_instruction(InstructionRequest(entry.kind, entry.target))
        for entry in record.plan
    ]


def task_words(record: EpisodeRecord) -> str:
    """The instruction of an episode: that of its single subtask, or of the whole task."""
    if record.instruction:
        return without_teleport_mark(record.instruction)
    if record.subtask:
        return subtask_words(record)[0]
    requests = [InstructionRequest(entry.kind, entry.target) for entry in record.plan]
    return task_instruction(record.task, requests)


def navigates_by_teleport(episode: RecordedEpisode) -> bool:
    """Whether the environment teleported the robot to every goal of an episode instead of letting it drive."""
    if (
        episode.record.subtask
        or episode.run.config.get("env", {}).get("navigate") != "teleport"
    ):
        return False
    return any(_is_way(entry.kind) for entry in episode.record.plan)


def teleported_steps(episode: RecordedEpisode) -> np.ndarray:
    """(N+1,) bool: states in which a Navigate subtask is active that the environment executes by teleport."""
    plan = episode.record.plan
    drives = np.array([_is_way(entry.kind) for entry in plan]) & navigates_by_teleport(
        episode
    )
    return drives[np.minimum(episode.array("subtasks/active"), len(plan) - 1)]


def _is_way(kind: str) -> bool:
    return kind in SUBTASKS and SUBTASKS[kind].navigates


def instructions_of(episode: RecordedEpisode) -> Instructions:
    """The instructions of an episode."""
    record = episode.record
    return Instructions(task_words(record), tuple(subtask_words(record)))


def state_names(columns: Mapping[str, int], layout: Mapping[str, Any]) -> list[str]:
    """A name for every column of ``obs/state``.

    Args:
        columns: names and widths of its parts (`RecordedEpisode.columns`).
        layout: of the run that made the episode (`RunInfo.layout`), which names the joints.
    """
    joints = tuple(layout.get("joints", OLDER_JOINTS))
    names = []
    for part, width in columns.items():
        head = part.rpartition("/")[2]
        parts = joints if part in _OF_JOINTS else _PARTS.get(part, ())
        # Other robots, and parts of plugins, have columns that nobody named.
        if len(parts) != max(width, 1):
            parts = tuple(map(str, range(width)))
        names += [f"{head}.{name}" for name in parts] if width > 1 else [head]
    return names
