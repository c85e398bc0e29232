"""Place zones: with goal type "zone", an object may lie anywhere on the receptacle of its goal."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import PlacedReceptacle, placed_receptacles
from mjhab.scenes.spec import Home
from mjhab.tasks.plan import TaskPlan
from mjhab.tasks.subtasks.registry import spec_of

_ABOVE = 0.35
"""A goal lies at most so far [m] above the surface that carries it: half the height of the tallest objects and room."""


def with_zones(plan: TaskPlan, layout: Layout, home: Home, tolerance: float) -> TaskPlan:
    """The plan with the zone of every object that goes to a goal: the rectangle of the receptacle under its goal.

    Where no receptacle is under a goal (imported episodes may leave them out), the zone is a square that reaches
    ``tolerance`` [m] from the goal.
    """
    receptacles = placed_receptacles(layout, home)
    return dataclasses.replace(
        plan,
        subtasks=tuple(
            dataclasses.replace(s, goal_rect=zone(s.goal_pos, receptacles, tolerance))
            if spec_of(s.kind).brings_to_goal
            else s
            for s in plan.subtasks
        ),
    )


def zone(
    goal: tuple[float, float, float], receptacles: Sequence[PlacedReceptacle], tolerance: float
) -> tuple[tuple[float, float], ...]:
    """Four corners (x, y) [m, world], in order around the rectangle, of the zone of a goal."""
    best = receptacle_below(goal, receptacles)
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    if best is None:
        return tuple((goal[0] + tolerance * u, goal[1] + tolerance * v) for u, v in signs)
    corners = (best.point(u * best.half[0], v * best.half[1]) for u, v in signs)
    return tuple((float(c[0]), float(c[1])) for c in corners)


def receptacle_below(
    point: tuple[float, float, float], receptacles: Sequence[PlacedReceptacle]
) -> PlacedReceptacle | None:
    """The receptacle with the nearest surface below a point [m, world], None if there is none."""
    best = None
    gap = _ABOVE
    for r in receptacles:
        above = point[2] - r.pos[2]
        # Few surfaces are at the right height: that is asked first.
        if -0.02 <= above < gap and r.holds(point[0], point[1]):
            best = r
            gap = above
    return best
