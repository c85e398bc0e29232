"""Headings of the scans of the objects that a recorded episode observes, for `core.conventions.to_scan_axes`.

mjhab turns the frame of a boxy object about its z axis until its sides lie along the axes; the heading of the scan's
axes in that frame is `scenes.spec.ObjectType.scan_yaw`. See docs/assets.md, "Headings of scanned boxes".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjhab.core.names import kind_of
from mjhab.data.store.run_entries import SCAN_YAWS
from mjhab.rollout.records import PlanEntry
from mjhab.tasks.plan import GOAL_OF
from mjhab.tasks.subtasks.registry import SUBTASKS


def shown_objects(plan: Sequence[PlanEntry]) -> tuple[str, ...]:
    """Type of the object that every subtask of a plan observes; "" for none, or where the record does not tell it.

    An Open observes the object inside, which is the one that the plan picks next.
    """
    shown = []
    picked = ""
    # From the end, because an Open shows what a later entry picks.
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


def headings(
    layout: Mapping[str, Any], plan: Sequence[PlanEntry], active: np.ndarray
) -> np.ndarray | None:
    """Heading [rad] of the scan of the observed object in every state, (N+1,); None if the run does not hold headings.

    Runs of older versions do not.

    Args:
        layout: of the run (`RunInfo.layout`).
        plan: of the episode.
        active: (N+1,) index of the active subtask, the length of the plan after its end.
    """
    known = layout.get(SCAN_YAWS)
    if known is None:
        return None
    by_entry = np.array(
        [known.get(name, 0.0) for name in shown_objects(plan)], np.float64
    )
    # A finished plan goes on showing its last object.
    return by_entry[np.minimum(active, len(plan) - 1)]
