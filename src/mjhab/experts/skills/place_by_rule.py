"""Script of Place by a rule, see `by_rule`, and the entry point that chooses between rule and search.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import numpy as np

from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import motion
from mjhab.experts.arm.held import held_spheres, holds
from mjhab.experts.arm.motion import Motion
from mjhab.experts.base.limits import limits_for
from mjhab.experts.phases import phase
from mjhab.experts.planning.carry import inside_depth
from mjhab.experts.planning.workplace import ReachScene, surroundings
from mjhab.experts.skills import place as search
from mjhab.experts.skills.by_rule import (
    STANDOFF_M,
    Funnel,
    Hands,
    RuledPlacement,
    find_placement,
    move_hand,
)
from mjhab.experts.skills.place_goals import Release, clear_hand_goals
from mjhab.experts.style import follows_rule

DOWN = np.array([0.0, 0.0, -1.0])
AT_GOAL_M = 0.012
AT_GOAL_RAD = 0.12
"""Distance and angle between hand and release pose below which the fingers open."""
SCORE_PRICE = 0.1
"""Angle [rad] that a difference of 1 in the score of a hand pose is worth."""
AWAY_M = 0.11
"""Distance from the release pose above which the arm moves to rest."""
AWAY_STEP_M = 0.02
"""Motion of the hand per control step while it leaves the object."""


def place(view: WorldView) -> Motion:
    """Place the held object at the goal of the active subtask, by the rule or by a search as the style demands."""
    return (
        yield from (place_by_rule(view) if follows_rule(view) else search.place(view))
    )


@phase("place by the rule", "carry")
def place_by_rule(view: WorldView) -> Motion:
    """Place the held object at its goal by the rule; by a search on shelves and where the rule finds no base placement.

    Ends when the object is lost: to pick it up again would need a search.
    """
    subtask = view.subtask
    assert subtask is not None
    obj = subtask.obj
    found = plan(view, obj, np.array(subtask.goal_pos)) if holds(view, obj) else None
    if found is None:
        return (yield from search.place(view))
    placement, funnel = found
    follower = placement.follower(limits_for(view))
    opens = False
    while opens or holds(view, obj):
        # From the measured speeds rather than the last commands: the script depends on what can be observed.
        drive = follower.step(view.base, motion.base_speeds(view))
        opens = opens or (
            funnel.distance(view) < AT_GOAL_M and funnel.turn(view) < AT_GOAL_RAD
        )
        if opens and not holds(view, obj) and not view.signal("at_goal"):
            break
        if opens and funnel.distance(view) > AWAY_M:
            yield motion.action(
                view, motion.rest_goal(view), gripper=motion.OPEN, drive=drive
            )
        elif opens:
            yield _away(view, funnel, holds(view, obj))
        elif placement.far(view):
            yield motion.action(
                view, motion.rest_goal(view), gripper=motion.CLOSED, drive=drive
            )
        else:
            yield funnel.step(view, motion.CLOSED, drive)
    return False


def _away(view: WorldView, funnel: Funnel, held: bool) -> np.ndarray:
    """Action (A,) that opens the fingers while the object is ``held``, then moves the hand back along its axis."""
    here, rot = motion.tcp(view)
    # Fingers that have not opened yet would carry the object along.
    aim = funnel.pos if held else here - AWAY_STEP_M * rot[:, 0]
    return move_hand(view, aim, rot, motion.OPEN, (0.0, 0.0), funnel.ready)


def plan(
    view: WorldView, obj: str, goal: np.ndarray
) -> tuple[RuledPlacement, Funnel] | None:
    """Choose base placement and release pose for an object at ``goal`` (3,) [m]; None on shelves or if none fits."""
    if inside_depth(view, goal):
        return None
    near, _ = surroundings(view, obj, goal)
    goals = clear_hand_goals(view, obj, goal, near, Release(shelf=False, any_side=False))
    support = float(goal[2]) - view.object_type(obj).half[2]
    # There is no object to reach for: what is held moves with the hand.
    nothing = near.take(np.zeros(0, np.int64))
    scene = ReachScene(near, nothing, support, view.robot, held_spheres(view, obj))
    # The hand must find its way back, too: a release that it cannot leave is none.
    away = goals.pos - AWAY_M * goals.rot[:, :, 0]
    above = goals.pos - STANDOFF_M * DOWN
    hands = Hands(goals.pos, goals.rot, above, away, -SCORE_PRICE * goals.score)
    placement = find_placement(view, scene, goal, hands)
    if placement is None:
        return None
    return placement, Funnel(
        goals.pos[placement.row], goals.rot[placement.row], DOWN, placement.ready
    )
