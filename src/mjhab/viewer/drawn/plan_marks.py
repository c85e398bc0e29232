"""The expert's plan for the active subtask as marks: path of the base, its base placement, candidate grasp poses."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from mjhab.experts.base.follower import BaseTrajectory
from mjhab.experts.base.route import Route
from mjhab.experts.phases import frames_of, phases_of
from mjhab.experts.planning.workplace import BasePlacement, HandGoals

# More cover each other, and each is a set of axes to draw.
MAX_CANDIDATES = 40
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class PlanMarks:
    """A plan as lines and poses in the world.

    Attributes:
        path: (P, 2) planned positions of the base [m].
        placement: (3,) x, y [m], yaw [rad] of the base at the end of the path, or None.
        hands: (G, 4, 4) candidate poses of the gripper, best first, at most `MAX_CANDIDATES`.
        chosen: index of the chosen candidate, or None.
        phase: what the script is doing, see `experts.phases`; "" if its functions have no names.
    """

    path: np.ndarray
    placement: np.ndarray | None
    hands: np.ndarray
    chosen: int | None
    phase: str = ""


def plan_marks(script: Generator[Any, Any, Any]) -> PlanMarks | None:
    """Extract the plan from a suspended script (generator) of the expert; None while it has none.

    A script keeps its plan in local variables of its nested generators. They are searched by type, innermost first.
    """
    held = list(_held(script))
    phase = next(reversed(phases_of(script)), "")
    placement = _first(held, BasePlacement)
    goals = _first(held, HandGoals)
    drive = _first(held, BaseTrajectory)
    if drive is not None:
        path = drive.poses[:, :2].copy()
        return PlanMarks(path, drive.poses[-1].copy(), _hand_poses(None), None, phase)
    route = _first(held, Route) or (None if placement is None else placement.route)
    if route is None and goals is None:
        return None
    path = np.zeros((0, 2)) if route is None else np.array(route.segment.points)
    place = None
    if placement is not None:
        place = placement.at[:3].copy()
    elif route is not None:
        place = np.append(path[-1], route.segment.yaw)
    chosen = None if placement is None or goals is None else int(placement.goal)
    return PlanMarks(path, place, _hand_poses(goals), chosen, phase)


def _first(held: list[Any], kind: type[T]) -> T | None:
    return next((value for value in held if isinstance(value, kind)), None)


def _held(script: Generator[Any, Any, Any]) -> Iterator[Any]:
    """Values of the local variables of a generator and of the generators it delegates to, innermost first."""
    for frame in reversed(list(frames_of(script))):
        for value in frame.f_locals.values():
            yield value
            # Scripts pass plans on in pairs, with a cost or a number beside.
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
