"""Headings of the scans of the objects that a recorded episode observes; see `core.scan_axes`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjhab.core.names import kind_of
from mjhab.data.store.reading import Episode
from mjhab.rollout.records import PlanEntry
from mjhab.tasks.plan import GOAL_OF
from mjhab.tasks.subtasks.registry import SUBTASKS

SCAN_YAWS = "scan_yaws"
"""Key of `RunInfo.layout`: `ObjectType.scan_yaw` [rad] by type of object, without those that are 0."""


def shown_objects(plan: Sequence[PlanEntry]) -> tuple[str, ...]:
    """Type of the object that every subtask of a plan observes; "" for none, or where the record does not tell it.

    An Open observes the object inside, which is the one that the plan picks next.
    """
    shown = []
    picked = ""
    for entry in reversed(plan):
        about = SUBTASKS[entry.kind].about
        if about == "object":
            picked = kind_of(entry.target)
            shown.append(picked)
        elif about == "way":
            carries = entry.target.startswith(GOAL_OF)
            shown.append(kind_of(entry.target.removeprefix(GOAL_OF)) if carries else "")
        else:
            shown.append(picked)
    return tuple(reversed(shown))


def scan_yaws(episode: Episode) -> np.ndarray | None:
    """Heading [rad] of the scan of the observed object in every state, (N+1,); None if the run does not hold headings.

    Runs of older versions do not.
    """
    known = episode.run.layout.get(SCAN_YAWS)
    if known is None:
        return None
    plan = episode.record.plan
    by_entry = np.array([known.get(name, 0.0) for name in shown_objects(plan)], np.float64)
    return by_entry[np.minimum(episode.array("subtasks/active"), len(plan) - 1)]
