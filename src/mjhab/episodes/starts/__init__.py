"""Start states and plans of episodes. Each subtask has a file here, which its `SubtaskSpec` refers to."""

from mjhab.episodes.starts.maker import (
    StartMaker,
    aims_of,
    check_target,
    subtask_positions,
    valid_targets,
)
from mjhab.episodes.starts.scene import Start, StartContext, SubtaskContext, SubtaskStart

__all__ = [
    "Scene",
    "Situation",
    "Start",
    "StartMaker",
    "SubtaskStart",
    "aims_of",
    "check_target",
    "subtask_positions",
    "valid_targets",
]
