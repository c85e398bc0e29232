"""Where a recorded state holds what, and the target of the hand in the control steps of an episode."""

from __future__ import annotations

import numpy as np

from mjhab.core.errors import fault
from mjhab.data.store.reading import RecordedEpisode
from mjhab.tasks.subtasks.registry import SUBTASKS

OBJECT_KEY = "extra/obj_pose_wrt_base"
GOAL_KEY = "extra/goal_pos_wrt_base"


def state_columns(episode: RecordedEpisode, key: str) -> slice | None:
    """Columns of one observation in the recorded state; None if it has none."""
    at = 0
    for name, width in episode.columns("obs/state").items():
        if name == key:
            return slice(at, at + width)
        # 0 stands for a plain column, see `RecordedEpisode.columns`.
        at += width or 1
    return None


def active_entries(episode: RecordedEpisode) -> np.ndarray:
    """(N+1,) index in the plan of the active subtask of every state; the last one once the plan is finished."""
    last = len(episode.record.plan) - 1
    return np.minimum(episode.array("subtasks/active"), last)


def aims_at_goal(episode: RecordedEpisode) -> np.ndarray:
    """(N+1,) bool: the target is the observed goal, not the object, see `SubtaskSpec.aims_at_goal`."""
    aims = [SUBTASKS[entry.kind].aims_at_goal for entry in episode.record.plan]
    return np.array(aims)[active_entries(episode)]


def targets_in_base(episode: RecordedEpisode) -> np.ndarray:
    """Targets (N+1, 3) float32 in the frame of the base link [m], as they were observed.

    Raises:
        UsageError: the recorded state has neither object nor goal.
    """
    state = episode.array("obs/state")
    found = {}
    for key in (OBJECT_KEY, GOAL_KEY):
        columns = state_columns(episode, key)
        if columns is None:
            raise fault(
                f"episode {episode.name} of {episode.shard.path}",
                f"was recorded without {key} in its state, which views "
                "of the target are turned to; render other images.",
            )
        found[key] = state[:, columns]
    goals = aims_at_goal(episode)[:, None]
    return np.where(goals, found[GOAL_KEY], found[OBJECT_KEY][:, :3])
