"""The expert's plan for the active subtask as marks: path of the base, its base placement, candidate grasp poses."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjhab.experts.base.follower import BaseTrajectory
from mjhab.experts.base.route import Route
from mjhab.experts.planning.workplace import BasePlacement, HandGoals

MAX_CANDIDATES = 40


@dataclass(frozen=True, eq=False)
class PlanMarks:
    """A plan as lines and poses in the world.

    Attributes:
        path: (P, 2) planned positions of the base [m].
        placement: (3,) x, y [m], yaw [rad] of the base at the end of the path, or None.
        hands: (G, 4, 4) candidate poses of the gripper, best first, at most `MAX_CANDIDATES`.
        chosen: index of the chosen candidate, or None.
    """

    path: np.ndarray
    placement: np.ndarray | None
    hands: np.ndarray
    chosen: int | None


def plan_marks(script: Generator[Any, Any, Any]) -> PlanMarks | None:
    """Extract the plan from a suspended script (generator) of the expert; None while it has none.

    A script keeps its plan in local variables of its nested generators. They are searched by type, innermost first.
    """
    held = list(_held(script))
    placement = next((value for value in held if isinstance(value, BasePlacement)), None)
    goals = next((value for value in held if isinstance(value, HandGoals)), None)
    trajectory = next(
        (value for value in held if isinstance(value, BaseTrajectory)), None
    )
    if trajectory is not None and len(trajectory.poses):
        return PlanMarks(
            trajectory.poses[:, :2].copy(),
            trajectory.poses[-1].copy(),
            _hand_poses(None),
            None,
        )
    routes = [value for value in held if isinstance(value, Route)]
    route = routes[0] if routes else placement.route if placement is not None else None
    if route is None and placement is None and goals is None:
        return None
    path = route.segment.points if route is not None else np.zeros((0, 2))
    place = None
    if placement is not None:
        place = placement.at[:3].copy()
    elif route is not None:
        place = np.append(route.segment.points[-1], route.segment.yaw)
    chosen = int(placement.goal) if placement is not None and goals is not None else None
    return PlanMarks(np.array(path), place, _hand_poses(goals), chosen)


def _held(script: Generator[Any, Any, Any]) -> Iterator[Any]:
    """Values of the local variables of a generator and of the generators it delegates to, innermost first."""
    frames = []
    inner: Any = script
    while inner is not None and getattr(inner, "gi_frame", None) is not None:
        frames.append(inner.gi_frame)
        inner = inner.gi_yieldfrom
    for frame in reversed(frames):
        for value in frame.f_locals.values():
            yield value
            if isinstance(value, tuple):
                yield from value


def _hand_poses(goals: HandGoals | None) -> np.ndarray:
    if goals is None:
        return np.zeros((0, 4, 4))
    count = min(len(goals), MAX_CANDIDATES)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = goals.rot[:count]
    poses[:, :3, 3] = goals.pos[:count]
    return poses
