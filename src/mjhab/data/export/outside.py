"""What exports ask of packages that `data` does not know: robots, and their controllers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjhab.data.export.columns import action_columns
from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.reading import RecordedEpisode

Actions = tuple[np.ndarray, np.ndarray]
"""Executed and intended actions (N, A) float32."""


def as_recorded(episode: RecordedEpisode, mode: str) -> Actions:
    """The actions of an episode, whose ``mode`` is "": that of the recording."""
    assert not mode, "other modes need a robot"
    return episode.array("actions"), episode.array("actions_intended")


def recorded_columns(run: RunInfo, mode: str) -> list[dict[str, Any]]:
    """Name, unit and frame of every entry of the recorded actions."""
    return action_columns(run)


def _on_the_floor(run: RunInfo) -> float:
    return 0.0


@dataclass(frozen=True)
class Outside:
    """Functions of other packages.

    actions: actions of an episode as those of another control mode ("" for the recorded one). columns: what their
    entries are. base_height: of the robot's base link above the floor [m].
    """

    actions: Callable[[RecordedEpisode, str], Actions] = as_recorded
    columns: Callable[[RunInfo, str], list[dict[str, Any]]] = recorded_columns
    base_height: Callable[[RunInfo], float] = _on_the_floor
