"""Configuration of the environments: frozen, with defaults, checked where it is made."""

from __future__ import annotations

from dataclasses import dataclass

from mjhab.core.errors import UsageError, unknown_name
from mjhab.tasks.plan import KIND_NAMES, TASKS

SPLITS = ("train", "val", "test")
AUTORESET_MODES = ("same_step", "disabled")
SUBTASKS_OF_TASK = {
    "tidy_house": ("pick", "place", "navigate"),
    "prepare_groceries": ("pick", "place", "navigate"),
    "set_table": ("pick", "place", "navigate", "open", "close"),
}


@dataclass(frozen=True)
class EnvConfig:
    """What world to build and what to do in it.

    task: HAB task. subtask: "" for the whole chain, or one kind of it, evaluated alone to its horizon.
    target: restricts ``subtask`` (or the draw of targets) to an object type or a link; "" for any.
    split, home: homes to draw from, or one home by name. assets: "builtin" or a folder.
    threads: 0 takes every core. cameras: outputs ("depth", "rgb", "seg") of both robot cameras; none by default.
    autoreset: what happens to a world after its episode ended.
    episodes_file: a file in the HAB format whose i-th episode is episode i, in the home it names; "" to generate.
    """

    task: str = "set_table"
    subtask: str = ""
    target: str = ""
    num_envs: int = 1
    split: str = "train"
    home: str = ""
    assets: str = "builtin"
    seed: int = 0
    threads: int = 0
    cameras: tuple[str, ...] = ()
    camera_size: int = 128
    autoreset: str = "same_step"
    episodes_file: str = ""

    def __post_init__(self) -> None:
        if self.task not in TASKS:
            raise unknown_name("task", self.task, TASKS)
        if self.subtask and self.subtask not in KIND_NAMES:
            raise unknown_name("subtask", self.subtask, KIND_NAMES)
        if self.subtask and self.subtask not in SUBTASKS_OF_TASK[self.task]:
            having = [t for t in TASKS if self.subtask in SUBTASKS_OF_TASK[t]]
            raise UsageError(
                f"task {self.task!r} has no subtask {self.subtask!r}; it has {', '.join(SUBTASKS_OF_TASK[self.task])}. "
                f"{self.subtask!r} belongs to: {', '.join(having)}."
            )
        if self.num_envs < 1:
            raise UsageError(f"the number of worlds must be at least 1, got {self.num_envs}")
        if self.split not in SPLITS:
            raise unknown_name("split", self.split, SPLITS)
        if self.autoreset not in AUTORESET_MODES:
            raise unknown_name("autoreset mode", self.autoreset, AUTORESET_MODES)
        for output in self.cameras:
            if output not in ("depth", "rgb", "seg"):
                raise unknown_name("camera output", output, ("depth", "rgb", "seg"))
        if self.camera_size < 8:
            raise UsageError(f"camera_size must be at least 8 pixels, got {self.camera_size}")
        if self.threads < 0:
            raise UsageError(f"threads must be 0 (all cores) or more, got {self.threads}")
