"""Sampling-based planning of base and arm for Pick and Place, used where straight motions of the arm collide.

`plan_route` moves the arm on one straight line in joint space. Between the open door of a fridge
and a counter there is often no room to drive so. `plan_around` draws postures, takes those with which the whole drive
is clear, and brings the arm into one before it and out of it after: straight where that is clear, else along a way
that RRT-Connect of OMPL finds. What it gives is a function of its arguments alone.

Lengths [m], angles [rad], world frame. Letters: T control steps, V postures, P pieces, Q joints.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from mjhab.core.joints import BASE, BASE_YAW
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.arm.clearance import Boxes, RobotSpheres
from mjhab.experts.arm.gentle import Care
from mjhab.experts.base.route import (
    SELF_CLEARANCE_M,
    Route,
    arm_gone,
    drive_of,
    torso_gone,
    within_reach,
)
from mjhab.experts.planning.arm_ways import PLANNING_SEED, Free, arm_way
from mjhab.experts.planning.workplace import Blocked, HandGoals, Stance
from mjhab.robots.robot import Robot

Array = np.ndarray
MAX_POSTURES = 1000
"""Postures of the arm that are sampled."""
MAX_CLEAR_POSTURES = 80
"""Number of postures with a clear drive that are tried, fastest first."""
BASES_TRIED = 3
"""Base poses per kind of reach for which a way is searched."""
WAYS_TIMED = 6
"""Ways to each base pose whose duration is computed."""
POSTURES_SEARCHED = 1
"""Postures for which RRT-Connect searches a way where no straight motion of the arm leads to them, or from them."""
MAX_DEFICIT_M = -0.03
"""Straight ways whose room is less than this (negative: a deficit, see `Route`) are worse than ways around, which
take longer."""
MIN_WAY_STEPS = 30
"""Least number of control steps of a way around."""
MIN_TOTAL_STEPS = 70
"""Least number of control steps of a way around and of what follows it."""
_PLACES = 14


Found = tuple[Stance, HandGoals, float]
"""A stance, the hand poses that it refers to, and how far the base comes straight in at the end [m]."""


def roomier(view: WorldView, found: Found | None, blocked: list[Blocked]) -> Found | None:
    """What was ``found``, or a way around to something ``blocked`` where that touches something on its way."""
    if (
        found is not None and found[0].route.room >= MAX_DEFICIT_M
    ) or view.steps_left < MIN_WAY_STEPS + MIN_TOTAL_STEPS:
        return found
    return _way_around(view, blocked) or found


def _way_around(view: WorldView, blocked: list[Blocked]) -> Found | None:
    """The quickest way to one kind of reach after the other, if it leaves enough time for the rest."""
    for reach in blocked:
        robot = reach.scene.robot()
        boxes = reach.scene.all
        tried = []
        best = None
        for goal, pre, at in zip(reach.goal, reach.pre, reach.at, strict=True):
            if len(tried) >= BASES_TRIED:
                break
            if any(np.array_equal(pre[BASE], base) for base in tried):
                continue
            tried.append(pre[BASE])
            back = reach.drive_in * np.array([np.cos(pre[BASE_YAW]), np.sin(pre[BASE_YAW]), 0.0])
            route = plan_around(view, pre[BASE] - back, pre, robot, boxes, care=reach.scene.care)
            if route is not None and (best is None or route.steps < best.route.steps):
                best = Stance(int(goal), pre, at, route)
        if best is not None and best.route.steps + MIN_TOTAL_STEPS <= view.steps_left:
            return best, reach.goals, reach.drive_in
    return None


def plan_around(
    view: WorldView,
    goal: Array,
    arm: Array,
    robot: RobotSpheres,
    boxes: Boxes,
    *,
    care: Care | None = None,
) -> Route | None:
    """A way to the base pose ``goal`` (3,) with the arm at ``arm`` (J,) that passes other postures before and after.

    ``robot`` is what moves, the held object included; ``care`` as in `plan_route`. None when nothing is found: all of
    the way that is given keeps as clear as `plan_route` asks for or, at its ends, nearly as clear as they are.
    """
    found = drive_of(view, goal, care=care)
    if found is None:
        return None
    path, direction, lookahead, poses = found
    start = view.q
    end = np.concatenate([goal, arm[BASE.stop :]])
    boxes = within_reach(boxes, np.stack([start[:2], goal[:2]]))
    here = Free.near(view.robot, start, robot, boxes)
    there = Free.near(view.robot, end, robot, boxes)
    postures = _postures(view.robot, start, end)
    postures = postures[_clear_drives(postures, poses, here)]
    best: tuple[int, int, int, Array, int] | None = None
    for first, last in _legs(start, end, postures, here, there):
        found = _timed(first, last, poses, here, there)
        if best is None or found[0] < best[0]:
            best = *found, np.concatenate([first[1:], last[1:-1]]), len(first) - 2
    if best is None:
        return None
    steps, lead, delay, via, carried = best
    return Route(
        path,
        float(goal[2]),
        direction,
        lookahead,
        arm,
        delay,
        steps,
        0.0,
        via=via,
        carried=carried,
        lead=lead,
        care=care,
    )


def _timed(
    first: Array, last: Array, poses: Array, here: Free, there: Free
) -> tuple[int, int, int]:
    """How soon base and arm may move at the same time, on ways of the arm (P, J) before and after a drive over base
    poses (T, 3): steps of it all, steps that the base waits, and the step at which the arm goes on."""
    before = _along(here.body, first)
    after = _along(here.body, last)
    out = len(before)
    back = len(after)
    drive = len(poses)
    options = [
        (max(lead + drive, delay + back), lead, delay)
        for lead in {0, out // 2, out}
        for delay in {max(out, lead + drive - share * back // 2) for share in (0, 1, 2)}
    ]
    late = (out + drive + back, out, out + drive)
    for steps, lead, delay in sorted(options):
        if (steps, lead, delay) >= late:
            break
        t = np.unique(np.linspace(0, steps, 40).astype(int))
        arm = np.where(
            (t < delay)[:, None],
            before[np.minimum(t, out - 1)],
            after[np.clip(t - delay, 0, back - 1)],
        )
        arm[:, BASE] = poses[np.clip(t - lead, 0, drive - 1)]
        moving = (t > lead) & (t < lead + drive - 1)
        asked = np.where(moving, here.drive, np.where(t <= lead, here.room, there.room))
        gap = np.minimum(
            here.robot.clearance(arm, here.boxes) - asked,
            here.robot.self_clearance(arm) - min(here.own, there.own),
        )
        if (gap >= 0.0).all():
            return steps, lead, delay
    return late


def _along(robot: Robot, way: Array) -> Array:
    """Configurations (N, J) after so many control steps on a way (P, J) of the arm."""
    torso = list(robot.torso_columns)
    arm = list(robot.arm_columns)
    delta = robot.limits.joint_delta
    parts = []
    for start, end in pairwise(way):
        far = np.abs(end - start)
        gone = [
            arm_gone(float(far[arm].max()), delta),
            torso_gone(float(far[torso].max(initial=0.0)), delta),
        ]
        t = np.arange(max(map(len, gone)))
        share = np.ones((len(t), len(far)))
        share[:, arm] = gone[0][np.minimum(t, len(gone[0]) - 1), None]
        share[:, torso] = gone[1][np.minimum(t, len(gone[1]) - 1), None]
        parts.append(start + share * (end - start))
    return np.concatenate(parts)


def _legs(
    start: Array, end: Array, postures: Array, here: Free, there: Free
) -> list[tuple[Array, Array]]:
    """Ways of the arm from ``start`` (J,) to one of postures (V, J), quickest first, and from there to ``end``."""
    if not len(postures):
        return []
    before = postures.copy()
    after = postures.copy()
    before[:, BASE] = start[BASE]
    after[:, BASE] = end[BASE]
    out = here.likely(start, before)
    back = there.likely(end, after)
    found = []
    for i in np.flatnonzero(out & back):
        if here.edge(start, before[i]) and there.edge(after[i], end):
            found.append((np.stack([start, before[i]]), np.stack([after[i], end])))
        if len(found) == WAYS_TIMED:
            break
    # One leg by sampling, of postures for which the other is clear.
    for i in np.flatnonzero(out ^ back)[: 0 if found else POSTURES_SEARCHED]:
        first = _leg(start, before[i], here) if out[i] else arm_way(start, before[i], here)
        last = (
            None
            if first is None
            else _leg(after[i], end, there)
            if back[i]
            else arm_way(after[i], end, there)
        )
        if first is not None and last is not None:
            return [(first, last)]
    return found


def _leg(start: Array, end: Array, free: Free) -> Array | None:
    """The straight way between two configurations (J,), if it is clear."""
    return np.stack([start, end]) if free.edge(start, end) else None


def _postures(robot: Robot, start: Array, end: Array) -> Array:
    """Postures (V, J) of the arm, those first that take the least time from ``start`` and on to ``end`` (J,)."""
    dofs = ik.columns(robot.chain)
    others = np.setdiff1d(np.arange(BASE.stop, len(start)), dofs)
    drawn = _library(robot).copy()
    drawn[:, others] = start[others]
    drawn = np.concatenate([ik.unwind(robot.chain, drawn, start), start[None], end[None]])
    fingers = robot.columns.fingers
    drawn[:, fingers] = start[fingers]
    steps = [ik.travel_steps(robot.chain, q, drawn, dofs) for q in (start, end)]
    return drawn[np.argsort(steps[0] + steps[1], kind="stable")]


@lru_cache(maxsize=8)
def _library(robot: Robot) -> Array:
    """Postures (V, J) around the one at rest that keep clear of the trunk."""
    drawn = ik.random_seeds(
        robot.chain,
        robot.rest,
        ik.columns(robot.chain),
        4 * MAX_POSTURES,
        np.random.default_rng(PLANNING_SEED),
        1.0,
    )
    return drawn[motion.spheres(robot).self_clearance(drawn) > 2 * SELF_CLEARANCE_M][:MAX_POSTURES]


def _clear_drives(postures: Array, poses: Array, free: Free) -> Array:
    """The first `MAX_CLEAR_POSTURES` postures (indices) with which a drive over base poses (T, 3) is clear, its
    errors included."""
    found: list[Any] = []
    for start in range(0, len(postures), 2 * MAX_CLEAR_POSTURES):
        rows = np.arange(start, min(start + 2 * MAX_CLEAR_POSTURES, len(postures)))
        for pose in poses[np.unique(np.linspace(0, len(poses) - 1, _PLACES).astype(int))]:
            q = postures[rows]
            q[:, BASE] = pose
            rows = rows[free.robot.clearance(q, free.boxes) >= free.drive]
        found += list(rows)
        if len(found) >= MAX_CLEAR_POSTURES:
            break
    return np.array(found[:MAX_CLEAR_POSTURES], np.int64)
