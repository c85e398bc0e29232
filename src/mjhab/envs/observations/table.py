"""The whole table of observations: space, and description for people and machines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from mjhab.envs.observations.entry import ObsEntry
from mjhab.envs.observations.modes import STATE_KEY
from mjhab.envs.observations.state import task_meanings
from mjhab.envs.spaces import ObservationSpace


def table_space(
    state: Sequence[ObsEntry], cameras: Sequence[ObsEntry]
) -> ObservationSpace:
    """Observation space of one world: the rows of ``state_table``, of ``camera_table``, and their ``state``."""
    box: dict[str, spaces.Space] = {
        entry.key: entry.space for entry in (*state, *cameras)
    }
    width = sum(entry.shape[0] for entry in state)
    # Unbounded: velocities and positions in the home have no natural limit.
    box[STATE_KEY] = spaces.Box(-np.inf, np.inf, (width,), np.float32)
    ends = np.cumsum([entry.shape[0] for entry in state]).tolist()
    starts = (0, *ends[:-1])
    columns = {
        (entry.key,): slice(start, end)
        for entry, start, end in zip(state, starts, ends, strict=True)
    }
    return ObservationSpace(box, columns)


def describe(
    state: Sequence[ObsEntry], cameras: Sequence[ObsEntry], kinds: Sequence[str]
) -> list[dict[str, Any]]:
    """Describe the rows of `table_space` as plain data: key, shape, dtype, unit, frame, meaning.

    Args:
        state: rows of ``state``.
        cameras: rows of the cameras.
        kinds: subtasks for which the task rows are explained.

    Raises:
        UsageError: there is no such subtask.
    """
    meanings = task_meanings(kinds)
    rows = [
        {
            "key": entry.key,
            "shape": list(entry.shape),
            "dtype": np.dtype(entry.dtype).name,
            "unit": entry.unit,
            "frame": entry.frame,
            "meaning": meanings.get(entry.key, entry.meaning),
        }
        for entry in (*state, *cameras)
    ]
    meaning = "the rows " + ", ".join(entry.key for entry in state) + " in this order"
    rows.append(
        {
            "key": STATE_KEY,
            "shape": [sum(entry.shape[0] for entry in state)],
            "dtype": "float32",
            "unit": "mixed",
            "frame": "mixed",
        }
        | {"meaning": meaning}
    )
    return rows
