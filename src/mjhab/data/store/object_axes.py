"""Poses of objects in the axes of their scans, as MS-HAB's observations give them, and the headings of the scans.

mjhab turns the frame of a boxy object about its z axis until its sides lie along the axes; the heading of the scan's
axes in that frame is `scenes.spec.ObjectType.scan_yaw`. See docs/assets.md, "Headings of scanned boxes".
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjhab.core.names import kind_of
from mjhab.core.rotations import quat_canonical, quat_from_yaw, quat_mul
from mjhab.data.store.reading import RecordedEpisode
from mjhab.data.store.run_entries import SCAN_YAWS
from mjhab.rollout.records import PlanEntry
from mjhab.tasks.plan import GOAL_OF
from mjhab.tasks.subtasks.registry import SUBTASKS


def to_scan_axes(poses: np.ndarray, scan_yaw: np.ndarray | float) -> np.ndarray:
    """Poses (`OBJECT_POSE`) in the axes of the scans, for poses in mjhab's frames of the objects.

    Args:
        poses: (..., 7) position [m] and quaternion wxyz; a quaternion of zeros stays one.
        scan_yaw: (...) or one number, `ObjectType.scan_yaw` [rad] of the objects.

    Returns:
        New array of the same shape and type; quaternions have w >= 0.
    """
    yaw = np.broadcast_to(np.asarray(scan_yaw, np.float64), poses.shape[:-1])
    turned = poses.copy()
    # What is not turned keeps its bits.
    boxy = yaw != 0.0
    quats = quat_mul(poses[boxy][:, 3:].astype(np.float64), quat_from_yaw(yaw[boxy]))
    turned[boxy, 3:] = quat_canonical(quats)
    return turned


def from_scan_axes(poses: np.ndarray, scan_yaw: np.ndarray | float) -> np.ndarray:
    """Inverse of `to_scan_axes`."""
    return to_scan_axes(poses, -np.asarray(scan_yaw, np.float64))


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


def scan_yaws(episode: RecordedEpisode) -> np.ndarray | None:
    """Heading [rad] of the scan of the observed object in every state, (N+1,); None if the run does not hold headings.

    Runs of older versions do not.
    """
    known = episode.run.layout.get(SCAN_YAWS)
    if known is None:
        return None
    plan = episode.record.plan
    by_entry = np.array(
        [known.get(name, 0.0) for name in shown_objects(plan)], np.float64
    )
    return by_entry[np.minimum(episode.array("subtasks/active"), len(plan) - 1)]
