"""The dialects by name, and which of them a server speaks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjhab.core.errors import unknown_name
from mjhab.serving.dialects.behavior import Behavior
from mjhab.serving.dialects.dialect import OWN, Dialect
from mjhab.serving.dialects.lerobot import LeRobot
from mjhab.serving.dialects.openpi import OpenPi
from mjhab.serving.dialects.roboarena import RoboArena

_ROBOARENA_KEYS = frozenset(
    {"image_resolution", "needs_session_id", "n_external_cameras"}
)
_DIALECTS: tuple[Dialect, ...] = (OpenPi(), RoboArena(), Behavior(), LeRobot())
DIALECTS: dict[str, Dialect] = {dialect.name: dialect for dialect in _DIALECTS}


def dialect_named(name: str) -> Dialect:
    """A dialect by its name.

    Raises:
        UsageError: there is none of this name.
    """
    if name not in DIALECTS:
        raise unknown_name("dialect", name, DIALECTS)
    return DIALECTS[name]


def greeted_in(metadata: Mapping[str, Any]) -> str:
    """The dialect that a greeting tells of, "" if it does not."""
    own = metadata.get(OWN)
    spoken = own.get("dialect") if isinstance(own, Mapping) else None
    if isinstance(spoken, str) and spoken in DIALECTS:
        return spoken
    # Its greeting is the only one with keys of its own; others greet with anything.
    return RoboArena.name if set(metadata) >= _ROBOARENA_KEYS else ""


def answered_in(answer: Any) -> str:
    """The dialect that an answer is of, "" if it is of none."""
    if isinstance(answer, np.ndarray):
        return RoboArena.name
    if isinstance(answer, Mapping):
        # LeRobot's answer has the key of behavior, and is taken for it.
        for dialect, key in ((OpenPi.name, "actions"), (Behavior.name, "action")):
            if isinstance(answer.get(key), np.ndarray):
                return dialect
    return ""
