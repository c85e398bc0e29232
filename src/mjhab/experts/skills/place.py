"""Script of Place by a search: onto open surfaces, or into furniture such as a fridge.

Lengths [m], angles [rad], world frame. Letters: N attempts, J joints.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjhab.core.joints import BASE
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import motion
from mjhab.experts.arm.held import held_spheres, holds
from mjhab.experts.arm.motion import Motion
from mjhab.experts.base.limits import limits_for
from mjhab.experts.base.route import follow
from mjhab.experts.phases import phase
from mjhab.experts.planning.carry import (
    ReachIn,
    drive_in,
    go_home,
    inside_depth,
    shelf_start,
)
from mjhab.experts.planning.reach import placements, settle_reach
from mjhab.experts.planning.release import (
    away_speed,
    drawn_back,
    let_go_width,
)
from mjhab.experts.planning.sampled import Found, clearer
from mjhab.experts.planning.workplace import (
    CLEARANCES_M,
    BasePlacement,
    Blocked,
    HandGoals,
    ReachQuery,
    ReachScene,
    surroundings,
)
from mjhab.experts.skills.pick import pick_up
from mjhab.experts.skills.place_goals import Release, clear_hand_goals
from mjhab.experts.style import style_of, wait_for
from mjhab.tasks.style import DROP as DROP_IT

HAND_NEARER_M = 0.014
"""Difference between the least clearances of arm and hand above the release pose."""
MAX_BESIDE_M = 0.09
"""Greatest accepted deviation from the release position when the arm does not reach it from the present base pose."""
MAX_DEFICIT_M = -0.01
"""Routes with less ``clearance`` than this (negative: a deficit) may shake the object loose: others are tried first."""
AFTER_STEPS = 35
"""Control steps to put an object down and to retreat."""
INSIDE_AFTER_STEPS = 70
"""The same where the base first has to drive straight in."""
HOME_WEIGHT = 0.6
"""Weight of the control steps back to rest, relative to those to the goal."""
DROP_HEIGHTS_M = (0.0, 0.05, 0.12)
"""Heights from which an object is dropped on open surfaces, in this order, where it cannot be put down."""
SOFT_START = (0.25, 0.5, 0.75)
"""Speeds of the arm in its first control steps: a jerk can shake out an object at the fingertips."""
MAX_ATTEMPTS = 20
"""Plans after which a Place gives up; more than fit into its time."""
CAREFUL_PLANS = 2
"""Plans that are compared with another one if they are too slow or their routes too close to obstacles."""
WAIT_STEPS = 60
"""Control steps of waiting once all release poses have failed."""


@phase("place", "carry")
def place(view: WorldView) -> Motion:
    """Place the held object at the goal of the active subtask and return to rest; pick it up again if it is lost."""
    subtask = view.subtask
    assert subtask is not None
    obj = subtask.obj
    goal = np.array(subtask.goal_pos)
    while True:
        if holds(view, obj):
            yield from _bring(view, obj, goal)
        # Where it is does not matter to the script as long as the environment counts it as placed.
        elif not view.signal("at_goal"):
            # The object was lost on the way: pick it up again.
            yield from pick_up(view, obj, keep=False)
            continue
        yield from go_home(view, obj, holding=False)
        yield from _rest(view)


@phase("bring the object to its goal", "carry")
def _bring(view: WorldView, obj: str, goal: np.ndarray) -> Motion:
    """Place the held object at ``goal`` (3,) [m]. Returns whether the hand has released it."""
    search = _PlaceSearch(view, obj, goal)
    while search.number < MAX_ATTEMPTS:
        # What fell may lie at the goal: `place` looks.
        if not holds(view, obj):
            return True
        found = search.next()
        if found is None:
            if search.exhausted:
                yield from _wait(view)
            continue
        (placement, goals, depth) = found
        if (yield from _put(view, obj, placement, goals, depth)):
            return True
        search.failed = np.concatenate([search.failed, placement.at[None, BASE]])
    return False


class _PlaceSearch:
    """Successive plans for one object: first carefully, then in fast mode, then from greater heights.

    Attributes:
        number: plans made before.
        failed: (N, 3) base poses from which attempts have failed.
    """

    def __init__(self, view: WorldView, obj: str, goal: np.ndarray) -> None:
        self.number = 0
        self.failed = np.zeros((0, 3))
        self._view = view
        self._obj = obj
        self._goal = goal
        self._fast = False
        # Every search without a result moves on to the next height.
        self._nothing = 0
        """Searches without a result."""
        # On open surfaces every drop height is tried; inside furniture, failed base poses are tried once more.
        self._rounds = 2 if inside_depth(view, goal) else len(DROP_HEIGHTS_M)

    @property
    def exhausted(self) -> bool:
        """Whether everything has been tried without a result."""
        return self._nothing >= self._rounds

    def next(self) -> Found | None:
        """The best plan that is found; None if none is, and the next call searches differently."""
        best: Found | None = None
        # Tuples compare in order: a plan in time always beats one with more clearance.
        enough = (True, MAX_DEFICIT_M)
        while True:
            found = self._plan()
            if found is not None and (
                best is None or _worth(self._view, found) > _worth(self._view, best)
            ):
                best = found
            self.number += 1
            # The first plans are cheap to improve on: nothing has failed yet.
            if self.number > CAREFUL_PLANS or (
                best is not None and _worth(self._view, best) >= enough
            ):
                break
            self._fast = True
        if best is None:
            # Nothing else is left to try: the base poses that failed get another chance.
            self.failed = self.failed[:0]
            self._nothing += 1
        else:
            self._fast = False
        return best

    def _plan(self) -> Found | None:
        """One plan from the height of the style, or from the present one of `DROP_HEIGHTS_M`."""
        style = style_of(self._view)
        drop = DROP_HEIGHTS_M[self._nothing % len(DROP_HEIGHTS_M)]
        heights = (style.drop_height, 0.0) if style.release == DROP_IT else (drop,)
        for height in heights:
            attempt = Attempt(self.number, self.failed, height, self._fast)
            found = plan_place(self._view, self._obj, self._goal, attempt)
            if found is not None:
                return found
        return None


@phase("wait with the object in the hand", "hold")
def _wait(view: WorldView) -> Motion:
    """Hold still: what is in the way may move."""
    return (yield from motion.hold(view, WAIT_STEPS, gripper=motion.CLOSED))


def _worth(view: WorldView, found: Found) -> tuple[bool, float]:
    """Rank of a plan: whether it leaves enough time to return to rest, and the clearance of its route [m]."""
    placement, _, depth = found
    after = (INSIDE_AFTER_STEPS if depth else AFTER_STEPS) + float(
        motion.steps_home(view.robot, placement.at)
    )
    return placement.route.steps + after <= view.steps_left, placement.route.clearance


@phase("rest beside the placed object", "hold")
def _rest(view: WorldView) -> Motion:
    """Stay at rest with an open hand while the object is at its goal. Returns when it has left it."""
    goal = motion.rest_goal(view)
    off = 0
    # An object that rocks leaves its goal for a step or two and comes back.
    while off < 4:
        yield motion.action(view, goal, gripper=motion.OPEN)
        off = 0 if view.signal("at_goal") else off + 1
    return False


@dataclass(frozen=True, eq=False)
class Attempt:
    """One attempt to place an object.

    Attributes:
        number: number of attempts before it.
        failed: (N, 3) base poses from which attempts have failed.
        drop: height above an open surface from which the object is dropped [m].
        fast: drive faster and to nearer base placements, because time or clearance is short.
    """

    number: int
    failed: np.ndarray
    drop: float = 0.0
    fast: bool = False


def plan_place(
    view: WorldView, obj: str, goal: np.ndarray, attempt: Attempt
) -> Found | None:
    """Plan how to place an object near ``goal`` (3,) [m].

    Returns:
        Base placement, the hand poses that it refers to, and the length of the straight drive in [m]; None if none.
    """
    near, _ = surroundings(view, obj, goal)
    support = float(goal[2]) - view.object_type(obj).half[2]
    scene = ReachScene(
        near,
        near.take(np.zeros(0, np.int64)),
        support,
        view.robot,
        # The object is part of the robot while it is held, so that routes keep it clear, too.
        held_spheres(view, obj),
        limits_for(view, attempt.fast),
    )
    depth = inside_depth(view, goal)
    # Under a shelf the object often fits only on another side or tilted.
    late = attempt.number > 1
    inside = depth > 0.0
    release = Release(inside, inside or late, 0.0 if depth else attempt.drop)
    goals = clear_hand_goals(view, obj, goal, near, release)
    if not len(goals) and not depth:
        # A place that is no shelf can still have a board above it.
        goals = clear_hand_goals(
            view, obj, goal, near, Release(shelf=True, any_side=True)
        )
    blocked: list[Blocked] = []
    query = ReachQuery(
        point=goal,
        goals=goals,
        scene=scene,
        drive_in=depth,
        avoid=attempt.failed,
        clearance=CLEARANCES_M[min(attempt.number, 2)],
        nearer=HAND_NEARER_M,
        far=attempt.fast,
        home=HOME_WEIGHT,
        start=shelf_start(view, goal),
    )
    found = placements(view, query, blocked)
    return clearer(view, (found[0], goals, depth) if found else None, blocked)


@phase("put the object down", "place")
def _put(
    view: WorldView, obj: str, placement: BasePlacement, goals: HandGoals, depth: float
) -> Motion:
    """Drive to the base placement, lower the object, release it, retreat. Returns whether it is released."""
    pos = goals.pos[placement.goal]
    rot = goals.rot[placement.goal]
    pre = goals.pre[placement.goal]
    closed = motion.CLOSED
    yield from follow(view, placement.route, gripper=closed, held=obj)
    if not holds(view, obj):
        return False
    if depth:
        boxes, _ = surroundings(view, obj, pos)
        yield from drive_in(view, ReachIn(placement.pre, pre, rot), boxes, gripper=closed)
    joints = settle_reach(view, placement, np.stack([pre, pos]), rot)
    if joints is None:
        # The release pose is out of reach from here: use the planned posture, which deviates as the base does.
        joints, (pos, pre), rot = _beside(view, placement, goals)
        if np.linalg.norm(pos - goals.pos[placement.goal]) > MAX_BESIDE_M:
            return False
    # One control step each, until the arm has the speed of the plan.
    for speed in SOFT_START:
        yield from motion.move_joints(
            view, joints[0], gripper=closed, tolerance=0.04, max_steps=1, speed=speed
        )
    yield from motion.move_joints(
        view, joints[0], gripper=closed, tolerance=0.04, max_steps=20
    )
    # Without the torso, which is slow to stop and would overshoot downwards.
    near = motion.HandMove(
        pos=pre,
        rot=rot,
        gripper=closed,
        rest=joints[1],
        tolerance=0.015,
        max_steps=20,
        torso=False,
    )
    yield from motion.move_tcp(view, near)
    down = replace(near, pos=pos, speed=0.2, tolerance=0.005, max_steps=25)
    yield from motion.move_tcp(view, down)
    until = wait_for(view, motion.is_quiet)
    yield from motion.still_tcp(view, pos, rot, gripper=closed, steps=2, until=until)
    return (yield from _release(view, obj, down, pre, joints[0]))


@phase("let go of the object", "release")
def _release(
    view: WorldView, obj: str, at: motion.HandMove, above: np.ndarray, posture: np.ndarray
) -> Motion:
    """Open the fingers at the release pose ``at`` and draw the hand back. Returns whether the object is released.

    Args:
        view: world to act in.
        obj: name of the object.
        at: the motion that ended at the release pose.
        above: (3,) tcp position above it, to which the hand goes if the object sticks to it.
        posture: (J,) preferred posture on the way.
    """
    opening = motion.gripper_at(view.robot, let_go_width(view, obj, at.pos, at.rot))
    speed = away_speed(view)
    until = wait_for(view, motion.has_opened(opening))
    yield from motion.still_tcp(
        view, at.pos, at.rot, gripper=opening, steps=5, until=until
    )
    # Along the fingers first; upwards only if the object still clings to them.
    for back in (drawn_back(view, obj, at.pos, at.rot, posture), above):
        away = motion.HandMove(
            pos=back,
            rot=at.rot,
            gripper=opening,
            rest=posture,
            speed=speed,
            tolerance=0.02,
            max_steps=14,
            torso=False,
        )
        yield from motion.move_tcp(view, away)
        if not holds(view, obj):
            return True
    # Wide objects can still touch the open fingers: at the goal they count as released.
    return bool(view.signal("at_goal"))


def _beside(
    view: WorldView, placement: BasePlacement, goals: HandGoals
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Planned arm postures at the present base pose, for a base that stands beside its base placement.

    Returns:
        Configurations (2, J) above and at the release pose; tcp positions (2, 3) at and above it, in this order; and
        the tcp rotation (3, 3) at the release pose.
    """
    q = np.stack([placement.pre, placement.at])
    # The arm as planned, the base where it is: the hand is off by the same error.
    q[:, BASE] = view.base
    chain = view.robot.chain
    frames = chain.forward(q)
    tip = chain.tip_index
    return q, frames.pos[::-1, tip], frames.rot[1, tip]
