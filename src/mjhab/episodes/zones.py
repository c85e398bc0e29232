"""Place zones: with goal type "zone", Place succeeds anywhere on the receptacle of the goal."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import PlacedReceptacle, placed_receptacles
from mjhab.scenes.spec import Home
from mjhab.tasks.plan import TaskPlan
from mjhab.tasks.subtasks.registry import spec_of

_ABOVE = 0.35
"""Largest height [m] of a goal above the surface that carries it: half of the tallest objects, with a margin."""


def with_zones(plan: TaskPlan, layout: Layout, home: Home, tolerance: float) -> TaskPlan:
    """Return a plan whose subtasks that bring an object to a goal have a place zone.

    Args:
        plan: the plan.
        layout: layout of the home.
        home: home of the episode.
        tolerance: half side [m] of the square zone of a goal without a receptacle below it.
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
    goal: tuple[float, float, float],
    receptacles: Sequence[PlacedReceptacle],
    tolerance: float,
) -> tuple[tuple[float, float], ...]:
    """Return the zone of a goal: the rectangle of the receptacle below it.

    Args:
        goal: world position [m].
        receptacles: receptacles of the home.
        tolerance: half side [m] of the square around the goal that is its zone if there is no receptacle below it
            (imported episodes may lack them).

    Returns:
        Four corners (x, y) [m], world frame, in order around the rectangle.
    """
    best = receptacle_below(goal, receptacles)
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    if best is None:
        # A goal on no known surface: the square that its tolerance spans stands for one.
        return tuple((goal[0] + tolerance * u, goal[1] + tolerance * v) for u, v in signs)
    corners = (best.point(u * best.half[0], v * best.half[1]) for u, v in signs)
    return tuple((float(c[0]), float(c[1])) for c in corners)


def receptacle_below(
    point: tuple[float, float, float], receptacles: Sequence[PlacedReceptacle]
) -> PlacedReceptacle | None:
    """Return the receptacle with the nearest surface below a world point [m]; None if none is within ``_ABOVE``."""
    best = None
    gap = _ABOVE
    for r in receptacles:
        above = point[2] - r.pos[2]
        # Few surfaces are at the right height, so that the cheap height test is first.
        if -0.02 <= above < gap and r.holds(point[0], point[1]):
            best = r
            gap = above
    return best
