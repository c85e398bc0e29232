"""What episodes of an older schema lack, and what stands in its place when they are read."""

from __future__ import annotations

import numpy as np

STAND_INS: dict[str, str] = {"actions_intended": "actions", "actor": "actions"}
"""Dataset that schema 1 does not have to the one that it is made of."""


def stand_in(path: str, source: np.ndarray) -> np.ndarray:
    """The dataset at ``path`` of an episode without it, from ``STAND_INS[path]``: all by one actor, as intended."""
    return np.zeros(len(source), np.uint8) if path == "actor" else source
