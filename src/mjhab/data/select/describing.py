"""Recorded episodes in words and names: what exports and reports say about them."""

from __future__ import annotations

import re
from collections.abc import Mapping

from mjhab.data.select.facts import type_name
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import SUBTASKS

_JOINTS: tuple[str, ...] = (
    "torso_lift",
    "head_pan",
    "shoulder_pan",
    "head_tilt",
    "shoulder_lift",
    "upperarm_roll",
    "elbow_flex",
    "forearm_roll",
    "wrist_flex",
    "wrist_roll",
    "r_gripper_finger",
    "l_gripper_finger",
)
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_PARTS: dict[str, tuple[str, ...]] = {
    "agent/qpos": _JOINTS,
    "agent/qvel": _JOINTS,
    "extra/tcp_pose_wrt_base": _POSE,
    "extra/obj_pose_wrt_base": _POSE,
    "extra/goal_pos_wrt_base": ("x", "y", "z"),
}
"""Names of the numbers of an observation, in the order of the joints without the base (breadth-first, as MS-HAB)."""


def thing(target: str) -> str:
    """A target in words: "the bowl" for "024_bowl_:0003", "the drawer 3 of the kitchen counter" for a link."""
    furniture, _, part = type_name(target).rpartition("/")
    words = re.sub(r"^\d+_", "", part).replace("_", " ")
    words = re.sub(r"(?<=[a-z])(?=\d)", " ", words)
    return f"the {words} of the {furniture.replace('_', ' ')}" if furniture else f"the {words}"


def subtask_words(kind: str, target: str) -> str:
    """One subtask as an instruction: "Pick up the bowl."."""
    return SUBTASKS[kind].words.format(thing(target))


def task_words(record: EpisodeRecord) -> str:
    """What an episode is asked to do: the subtask that is done alone, or the whole task."""
    if record.subtask:
        return subtask_words(record.plan[0].kind, record.plan[0].target)
    return TASKS[record.task].words


def state_names(columns: Mapping[str, int]) -> list[str]:
    """A name for every number of ``obs/state``, from the names and widths of its parts (`Episode.columns`)."""
    names = []
    for part, width in columns.items():
        head = part.rpartition("/")[2]
        parts = _PARTS.get(part, ())
        if len(parts) != max(width, 1):
            parts = tuple(map(str, range(width)))
        names += [f"{head}.{name}" for name in parts] if width > 1 else [head]
    return names
