"""From an episode to the state and plan a world starts with: one file per subtask, found through its `SubtaskSpec`."""

from mjhab.episodes.starts.maker import (
    StartMaker,
    check_target,
    subtask_positions,
    valid_targets,
)
from mjhab.episodes.starts.scene import Scene, Situation, Start, SubtaskStart

__all__ = [
    "Scene",
    "Situation",
    "Start",
    "StartMaker",
    "SubtaskStart",
    "check_target",
    "subtask_positions",
    "valid_targets",
]
