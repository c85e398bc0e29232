"""Classes of MS-HAB's environments, one for each id; scripts ask whether an environment is of one."""

from __future__ import annotations

from typing import Any, ClassVar

from mjhab.compat.mshab.worlds.env import MsHabEnv


class MsHabSequentialTaskEnv(MsHabEnv):
    """A whole task: a chain of subtasks."""

    SUBTASK: ClassVar[str] = ""

    def __init__(self, **given: Any) -> None:
        super().__init__(subtask=self.SUBTASK, **given)


class SubtaskTrainEnv(MsHabSequentialTaskEnv):
    """One subtask, judged anew in every step."""


class PickSubtaskTrainEnv(SubtaskTrainEnv):
    """Pick."""

    SUBTASK: ClassVar[str] = "pick"


class PlaceSubtaskTrainEnv(SubtaskTrainEnv):
    """Place."""

    SUBTASK: ClassVar[str] = "place"


class OpenSubtaskTrainEnv(SubtaskTrainEnv):
    """Open."""

    SUBTASK: ClassVar[str] = "open"


class CloseSubtaskTrainEnv(SubtaskTrainEnv):
    """Close."""

    SUBTASK: ClassVar[str] = "close"


class NavigateSubtaskTrainEnv(SubtaskTrainEnv):
    """Navigate."""

    SUBTASK: ClassVar[str] = "navigate"
