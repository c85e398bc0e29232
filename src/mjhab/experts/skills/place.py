"""The expert for Place: onto tables and seats, or into the fridge."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.joints import BASE
from mjhab.core.rotations import mat_from_quat
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.arm.gentle import care_for
from mjhab.experts.arm.motion import Motion
from mjhab.experts.arm.release import (
    TIGHT_PLAY_M,
    away_speed,
    drawn_back,
    let_go_width,
    play,
    tipped,
)
from mjhab.experts.base.route import follow, holds
from mjhab.experts.planning.carry import (
    ReachIn,
    drive_in,
    go_home,
    grip,
    held_spheres,
    inside_depth,
)
from mjhab.experts.planning.reach import (
    CLEARANCES_M,
    Blocked,
    HandGoals,
    Scene,
    Stance,
    Work,
    hand_room,
    settle_reach,
    stances,
    surroundings,
)
from mjhab.experts.planning.sampled import Found, roomier
from mjhab.experts.skills.pick import height_below, pick_up
from mjhab.experts.style import style_of, wait_for
from mjhab.tasks.style import DROP as DROP_IT

Array = np.ndarray
DROP_HEIGHT_M = 0.006
"""Height above the surface at which an object is let go."""
ABOVE_M = 0.10
"""Height at which the straight way down begins."""
SHELF_ABOVE_M = 0.035
"""The same on a shelf."""
YAWS = 16
SHELF_YAWS = 8
OFFSETS = ((0.0, 0.0), (0.05, 0.0), (0.10, 0.0))
LAST_OFFSETS = (*OFFSETS, (0.125, 0.0))
SHELF_OFFSETS = (
    *OFFSETS,
    (0.05, 0.05),
    (0.05, -0.05),
    (0.0, 0.06),
    (0.0, -0.06),
    (0.08, 0.06),
    (0.08, -0.06),
)
"""How far [m] nearer to the robot, and to its side, than the goal an object may be put; success asks for 0.15. The last
ones are for later attempts."""
TILTS = (0.0, 0.3)
BALL_TILTS = (0.0, 0.35, 0.7, 1.0)
SHELF_TILTS = (0.0, 0.35, 0.6, 0.85, 1.1)
"""Leans of the hand [rad]: they reach further, and under a shelf a hand that comes from above has no room."""
HAND_CLEARANCE_M = -0.008
"""Least clearance of the hand: the spheres that stand for it are up to so much too large."""
HAND_NEARER_M = 0.014
"""How much nearer than the arm the hand may come to its surroundings before it goes down."""
LEAN_PRICE = 2.5
"""Score lost per radian that an object leans when it is let go under a shelf."""
LAID_PRICE = 2.6
"""Score lost when another side of it is down: round things roll then, and lean until they fall."""
STUCK_FACTOR = 3.0
"""Factor on `LEAN_PRICE` where the fingers cannot open much farther: the object stays between them at that angle, and
falls when the hand draws back."""
MAX_BESIDE_M = 0.09
"""Greatest distance beside its place at which an object is put when the base stands where the arm does not reach it."""
GOAL_SHARE = 0.87
"""Share of the tolerance at the goal within which an object is put, measured where it comes to rest after it tipped
over."""
MAX_DEFICIT_M = -0.01
"""Ways whose room is less than this (negative: a deficit) may knock the object out of the hand: others are tried
first."""
AFTER_STEPS = 35
"""Control steps to put an object down and draw back."""
INSIDE_AFTER_STEPS = 70
"""The same where the base has to drive straight in before."""
HOME_WEIGHT = 0.6
"""Weight of the control steps back to rest, relative to those to the goal."""
DROP_HEIGHTS_M = (0.0, 0.05, 0.12)
"""Heights from which an object is dropped in the open, tried in this order, where there is no way to put it down."""
SOFT_START = (0.25, 0.5, 0.75)
"""Shares of its speed with which the arm starts: an object that hangs at the fingertips would fall out otherwise."""
WAIT_STEPS = 60
"""Control steps to wait once every way to put an object was tried without success."""


def place(view: WorldView) -> Motion:
    """Put the held object to the active subtask's goal and return to rest."""
    subtask = view.subtask
    assert subtask is not None
    obj = subtask.obj
    goal = np.array(subtask.goal_pos)
    while True:
        if holds(view, obj):
            yield from _bring(view, obj, goal)
        elif not view.signal("at_goal"):
            # Lost on the way: it lies somewhere, mostly not far off.
            yield from pick_up(view, obj, keep=False)
            continue
        yield from go_home(view, obj, holding=False)
        yield from _rest(view)


def _bring(view: WorldView, obj: str, goal: Array) -> Motion:
    """Put the held object to ``goal`` (3,). Returns whether the hand has let go of it."""
    style = style_of(view)
    failed = np.zeros((0, 3))
    hurry = False
    nothing = 0
    best: Found | None = None
    for attempt in range(20):
        if not holds(view, obj):
            return True
        drop = (
            style.drop_height
            if style.release == DROP_IT
            else DROP_HEIGHTS_M[nothing % len(DROP_HEIGHTS_M)]
        )
        tried = Attempt(attempt, failed, drop, hurry)
        found = plan_place(view, obj, goal, tried)
        if found is None and style.release == DROP_IT:
            found = plan_place(view, obj, goal, replace(tried, drop=0.0))
        if found is not None and (best is None or _worth(view, found) > _worth(view, best)):
            best = found
        if attempt < 2 and (best is None or _worth(view, best) < (True, MAX_DEFICIT_M)):
            hurry = True
            continue
        if best is None:
            failed = failed[:0]
            nothing += 1
            # In the open things can fall; inside there is only what has failed to be looked at once more.
            if nothing >= (2 if inside_depth(view, goal) else len(DROP_HEIGHTS_M)):
                yield from motion.hold(view, WAIT_STEPS, gripper=motion.CLOSED)
            continue
        (stance, goals, depth) = best
        best = None
        hurry = False
        if (yield from _put(view, obj, stance, goals, depth)):
            return True
        failed = np.concatenate([failed, stance.at[None, BASE]])
    return False


def _worth(view: WorldView, found: Found) -> tuple[bool, float]:
    """Whether a way to put an object leaves the time to come back to rest, and the room on its route [m]."""
    stance, _, depth = found
    after = (INSIDE_AFTER_STEPS if depth else AFTER_STEPS) + float(
        motion.steps_home(view.robot, stance.at)
    )
    return stance.route.steps + after <= view.steps_left, stance.route.room


def _rest(view: WorldView) -> Motion:
    """Stay at rest with an open hand for as long as the object is at its goal. Returns when it is not."""
    goal = motion.rest_goal(view)
    off = 0
    while off < 4:
        yield motion.action(view, goal, gripper=motion.OPEN)
        off = 0 if view.signal("at_goal") else off + 1
    return False


@dataclass(frozen=True, eq=False)
class Attempt:
    """One try to put an object to its goal.

    Attributes:
        number: of the tries before it.
        failed: (N, 3) base poses from which it did not come off.
        drop: height above its place in the open in which the hand lets go [m].
        hurry: drive faster and no farther than needed, where the time or the room on the way would not do.
    """

    number: int
    failed: Array
    drop: float = 0.0
    hurry: bool = False


@dataclass(frozen=True)
class Release:
    """How the hand may let go of an object.

    Attributes:
        shelf: something is above: lean the hand forwards too, and begin lower.
        any_side: the object may come to lie on any of its sides.
        drop: height that it falls [m].
    """

    shelf: bool
    any_side: bool
    drop: float = 0.0


def plan_place(view: WorldView, obj: str, goal: Array, attempt: Attempt) -> Found | None:
    """The best way to put an object near ``goal`` (3,): stance, hand poses it refers to, depth as in `plan_pick`."""
    near, _ = surroundings(view, obj, goal)
    support = float(goal[2]) - view.object_type(obj).half[2]
    scene = Scene(
        near,
        near.take(np.zeros(0, np.int64)),
        support,
        view.robot,
        held_spheres(view, obj),
        care_for(view, attempt.hurry),
    )
    depth = inside_depth(view, goal)
    # Under a shelf the choice is often between one of its other sides and letting go of it at an angle.
    late = attempt.number > 1
    inside = depth > 0.0
    release = Release(inside, inside or late, 0.0 if depth else attempt.drop)
    goals = roomy(view, obj, goal, near, release)
    if not len(goals) and not depth:
        # A board above leaves no room to come from above, though nothing calls the place a shelf.
        goals = roomy(view, obj, goal, near, Release(shelf=True, any_side=True))
    blocked: list[Blocked] = []
    work = Work(
        point=goal,
        goals=goals,
        scene=scene,
        drive_in=depth,
        avoid=attempt.failed,
        room=CLEARANCES_M[min(attempt.number, 2)],
        nearer=HAND_NEARER_M,
        far=attempt.hurry,
        home=HOME_WEIGHT,
    )
    found = stances(view, work, blocked)
    return roomier(view, (found[0], goals, depth) if found else None, blocked)


def roomy(view: WorldView, obj: str, goal: Array, near: Boxes, release: Release) -> HandGoals:
    """`hand_goals` with room for the hand among the boxes ``near``."""
    goals = hand_goals(view, obj, goal, release)
    return goals.take(
        np.flatnonzero(
            hand_room(view.robot.gripper, goals, near.near(goal, 0.8)) > HAND_CLEARANCE_M
        )
    )


def hand_goals(view: WorldView, obj: str, goal: Array, release: Release) -> HandGoals:
    """Hand poses that put the object, as it sits in the hand, upright near ``goal`` (3,)."""
    shelf = release.shelf
    any_side = release.any_side
    drop = release.drop
    shape = view.object_shape(obj)
    tcp, hand = motion.tcp(view)
    pose = view.object_pose(obj)
    turn = hand.T @ mat_from_quat(pose[3:])
    offset = hand.T @ (pose[:3] - tcp)
    floor = float(goal[2]) - shape.half[2]
    # Tall things fall over when they are let go at an angle.
    ball = shape.kind == "sphere"
    upset = 0.2 if ball else LEAN_PRICE if shelf else 2.0 + 2.0 * shape.half[2] / min(shape.half)
    upset *= STUCK_FACTOR if not ball and play(view) < TIGHT_PLAY_M else 1.0
    back = view.base[:2] - goal[:2]
    back = back / max(float(np.linalg.norm(back)), 1e-6)
    aside = np.array([-back[1], back[0]])
    offsets = SHELF_OFFSETS if shelf else LAST_OFFSETS if any_side else OFFSETS
    spots = [goal[:2] + near * back + left * aside for near, left in offsets]
    spots = [spot for i, spot in enumerate(spots) if not i or _on_surface(view, goal, spot)]
    most = GOAL_SHARE * view.config.goal_tol
    yaws = np.arange(SHELF_YAWS if shelf else YAWS) * 2 * np.pi / (SHELF_YAWS if shelf else YAWS)
    tilts = SHELF_TILTS if shelf else BALL_TILTS if ball else TILTS
    turns = ik.rotate(yaws[:, None] * np.array([0.0, 0.0, 1.0]))
    leans = ik.rotate(np.array(tilts)[:, None] * np.array([*aside, 0.0]))
    pos = []
    rot = []
    score = []
    leaning = list(zip(tilts, leans, strict=True))
    ways: Any = itertools.product(_sides(any_side), turns, leaning)
    for (side, price), about, (tilt, lean) in ways:
        stand = lean @ (about @ side)
        low = height_below(shape, stand)
        tips = tipped(shape, stand)
        for spot in spots:
            # Where it is let go, such that it comes to rest at the spot.
            if np.linalg.norm(np.array([*spot, floor + low + tips[2]]) - goal) > most:
                continue
            rot.append(stand @ turn.T)
            pos.append(
                np.array([*(spot - tips[:2]), floor + low + max(DROP_HEIGHT_M, drop)])
                - rot[-1] @ offset
            )
            score.append(-price - upset * tilt - 6.0 * float(np.linalg.norm(spot - goal[:2])))
    at = np.array(pos)
    pre = at + np.array([0.0, 0.0, SHELF_ABOVE_M if shelf else ABOVE_M])
    width = np.full(len(at), 2.0 * float(view.q[view.robot.columns.fingers].mean()))
    return HandGoals(at, np.array(rot), pre, width, np.array(score))


def _sides(every: bool) -> list[tuple[Array, float]]:
    """Turns of an object that bring one of its sides down, with their price: upright costs nothing."""
    sides = [(np.eye(3), 0.0)]
    if every:
        half = np.pi / 2
        for axis in ((half, 0, 0), (-half, 0, 0), (0, half, 0), (0, -half, 0), (2 * half, 0, 0)):
            sides.append((ik.rotate(np.array([axis], float))[0], LAID_PRICE))
    return sides


def _on_surface(view: WorldView, goal: Array, xy: Array) -> bool:
    """Whether ``xy`` (2,) lies on the receptacle that ``goal`` (3,) is on."""
    for place in view.home.receptacles:
        level = -0.05 < goal[2] - place.pos[2] < 0.25
        if level and (np.abs(place.local(goal[:2])) < np.array(place.half)).all():
            return bool((np.abs(place.local(xy)) < np.array(place.half) - 0.02).all())
    return False


def _put(view: WorldView, obj: str, stance: Stance, goals: HandGoals, depth: float) -> Motion:
    """Drive there, lower, let go, draw back. Returns whether the hand has let go."""
    pos = goals.pos[stance.goal]
    rot = goals.rot[stance.goal]
    pre = goals.pre[stance.goal]
    closed = motion.CLOSED
    yield from follow(view, stance.route, gripper=closed, held=obj)
    if not holds(view, obj):
        return False
    if depth:
        boxes, _ = surroundings(view, obj, pos)
        yield from drive_in(view, ReachIn(stance.pre, pre, rot), boxes, gripper=closed)
    joints = settle_reach(view, stance, np.stack([pre, pos]), rot)
    if joints is None:
        # Out of reach from here: as planned then, beside its place by as much as the base is.
        joints, (pos, pre), rot = _beside(view, stance, goals)
        if np.linalg.norm(pos - goals.pos[stance.goal]) > MAX_BESIDE_M:
            return False
    for speed in SOFT_START:
        yield from motion.move_joints(
            view, joints[0], gripper=closed, tolerance=0.04, max_steps=1, speed=speed
        )
    yield from motion.move_joints(view, joints[0], gripper=closed, tolerance=0.04, max_steps=20)
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
    opening = grip(view.robot, let_go_width(view, obj, pos, rot))
    speed = away_speed(view)
    until = wait_for(view, motion.has_opened(opening))
    yield from motion.still_tcp(view, pos, rot, gripper=opening, steps=5, until=until)
    for back in (drawn_back(view, obj, pos, rot, joints[0]), pre):
        away = motion.HandMove(
            pos=back,
            rot=rot,
            gripper=opening,
            rest=joints[0],
            speed=speed,
            tolerance=0.02,
            max_steps=14,
            torso=False,
        )
        yield from motion.move_tcp(view, away)
        if not holds(view, obj):
            return True
    # Wide things touch the open fingers a little longer; to take them again would be to carry them off.
    return bool(view.signal("at_goal"))


def _beside(view: WorldView, stance: Stance, goals: HandGoals) -> tuple[Array, Array, Array]:
    """The planned postures of the arm (2, J) from where the base really stands, before and at the end of the way down,
    and where they bring the hand: at and before (2, 3), rotation (3, 3)."""
    q = np.stack([stance.pre, stance.at])
    q[:, BASE] = view.base
    chain = view.robot.chain
    frames = chain.forward(q)
    tip = chain.tip_index
    return q, frames.pos[::-1, tip], frames.rot[1, tip]
