"""Start states and plans of episodes. Each subtask has a file here, which its `SubtaskSpec` refers to."""

import warnings
from typing import Any

from mjhab.episodes.starts.maker import (
    StartMaker,
    aims_of,
    check_target,
    subtask_positions,
    valid_targets,
)
from mjhab.episodes.starts.scene import Start, StartContext, SubtaskContext, SubtaskStart

__all__ = [
    "Start",
    "StartContext",
    "StartMaker",
    "SubtaskContext",
    "SubtaskStart",
    "aims_of",
    "check_target",
    "subtask_positions",
    "valid_targets",
]

_OLD_NAMES = {"Scene": StartContext, "Situation": SubtaskContext}
"""Names that plugins may use for one more version."""


def __getattr__(name: str) -> Any:
    """A class by its old name, with a warning."""
    if name not in _OLD_NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    new = _OLD_NAMES[name]
    text = f"{__name__}.{name} is called {new.__name__} now; the old name goes with the next version."
    warnings.warn(text, DeprecationWarning, stacklevel=2)
    return new
