"""Where imported episodes come from, as far as their files do not say it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from mjhab.core.errors import unknown_name
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import take_options
from mjhab.tasks.household.registry import TASKS

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Origin:
    """Task and split of a file's episodes.

    Raises:
        UsageError: a name is unknown.
    """

    task: Annotated[
        str | None, Flag(shown="default: the folder above that of the subtask")
    ] = None
    """Task of the files."""
    split: Annotated[str, Flag(metavar="train|val|test")] = "train"
    """Split of the homes, if the files do not contain it; the published data are of train."""

    def __post_init__(self) -> None:
        take_options(self)
        if self.task is not None:
            TASKS.check(self.task)
        if self.split not in SPLITS:
            raise unknown_name("split", self.split, SPLITS)
