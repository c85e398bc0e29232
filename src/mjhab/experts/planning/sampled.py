"""Sampling-based planning of base and arm for Pick and Place, used where straight motions of the arm collide.

`plan_route` moves the arm on one straight line in joint space, which often collides in narrow places, for instance
between the open door of a fridge and a counter. `plan_around` samples postures of the arm and selects those with which
the whole drive is collision-free. The arm moves into such a posture before the drive and out of it afterwards: straight
in joint space where that is collision-free, else along a path found by RRT-Connect. The random seed is fixed, so that
equal arguments give equal results.

Lengths [m], angles [rad], world frame. Letters: T control steps, V postures, P configurations of a path, J joints, N
configurations.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
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
from mjhab.experts.base.limits import UNLIMITED, CommandLimits
from mjhab.experts.base.route import (
    SELF_CLEARANCE_M,
    Route,
    RouteWish,
    arm_gone,
    drive_of,
    torso_gone,
    within_reach,
)
from mjhab.experts.planning.arm_paths import PLANNING_SEED, Free, arm_path
from mjhab.experts.planning.workplace import BasePlacement, Blocked, HandGoals
from mjhab.robots.robot import Robot

MAX_POSTURES = 1000
"""Greatest number of postures of the arm that are sampled."""
MAX_CLEAR_POSTURES = 80
"""Greatest number of postures with a collision-free drive that are tried, fastest first."""
BASES_TRIED = 3
"""Base poses of each `Blocked` reach for which a route is searched."""
PATHS_TIMED = 6
"""Candidate arm motions per base pose whose duration is computed."""
POSTURES_SEARCHED = 1
"""Postures for which RRT-Connect searches the motion into them, or out of them, if the straight one collides."""
MAX_DEFICIT_M = -0.03
"""Straight routes with less ``clearance`` than this (negative: a deficit, see `Route`) are replaced by sampled
ones, which take longer."""
MIN_PATH_STEPS = 30
"""Least number of control steps of a sampled route."""
MIN_TOTAL_STEPS = 70
"""Control steps that must remain after a sampled route."""
_PLACES = 14
"""Base poses of a drive at which a posture is checked."""


Found = tuple[BasePlacement, HandGoals, float]
"""A base placement, the hand poses that it refers to, and the length of the straight drive in at the end [m]."""


def clearer(view: WorldView, found: Found | None, blocked: list[Blocked]) -> Found | None:
    """Replace a reach whose route collides by one with a sampled route.

    Args:
        view: the world.
        found: result of the search with straight routes; None if there is none.
        blocked: reaches whose straight routes lack clearance.

    Returns:
        ``found`` if its route has enough clearance, if time is short, or if no sampled route is found.
    """
    if (
        found is not None and found[0].route.clearance >= MAX_DEFICIT_M
    ) or view.steps_left < MIN_PATH_STEPS + MIN_TOTAL_STEPS:
        return found
    return _path_around(view, blocked) or found


def _path_around(view: WorldView, blocked: list[Blocked]) -> Found | None:
    """Quickest sampled route to the first of the ``blocked`` reaches for which one leaves `MIN_TOTAL_STEPS`."""
    # In the order in which they were found: the first ones have more clearance at the work.
    for reach in blocked:
        robot = reach.scene.robot()
        boxes = reach.scene.all
        tried = []
        best = None
        for goal, pre, at in zip(reach.goal, reach.pre, reach.at, strict=True):
            if len(tried) >= BASES_TRIED:
                break
            # Many hand poses share a base pose, and their drives collide alike.
            if any(np.array_equal(pre[BASE], base) for base in tried):
                continue
            tried.append(pre[BASE])
            back = reach.drive_in * motion.ahead_3d(pre[BASE_YAW])
            route = plan_around(
                view, pre[BASE] - back, pre, robot, boxes, limits=reach.scene.limits
            )
            if route is not None and (best is None or route.steps < best.route.steps):
                best = BasePlacement(int(goal), pre, at, route)
        if best is not None and best.route.steps + MIN_TOTAL_STEPS <= view.steps_left:
            return best, reach.goals, reach.drive_in
    return None


def plan_around(
    view: WorldView,
    goal: np.ndarray,
    arm: np.ndarray,
    robot: RobotSpheres,
    boxes: Boxes,
    *,
    limits: CommandLimits = UNLIMITED,
) -> Route | None:
    """Plan a collision-free route with intermediate postures of the arm before and after the drive.

    Args:
        view: the world.
        goal: (3,) base pose x, y, yaw.
        arm: (J,) configuration at the end, of which arm and torso count.
        robot: spheres that move, with those of the held object.
        boxes: obstacles.
        limits: limits on changes of the base commands, see `RouteWish`.

    Returns:
        A route with the clearances of `plan_route`, or nearly those of its first and last configuration if they have
        less; None when none is found.
    """
    base = drive_of(view, goal, RouteWish(limits=limits))
    if base is None:
        return None
    poses = base.poses
    start = view.q
    end = np.concatenate([goal, arm[BASE.stop :]])
    # Thousands of postures are checked: boxes that the arm cannot reach would multiply the time.
    boxes = within_reach(boxes, np.stack([start[:2], goal[:2]]))
    here = Free.near(view.robot, start, robot, boxes)
    there = Free.near(view.robot, end, robot, boxes)
    postures = _postures(view.robot, start, end)
    postures = postures[_clear_drives(postures, poses, here)]
    best: tuple[int, int, int, np.ndarray, int] | None = None
    for first, last in _arm_paths(start, end, postures, here, there):
        found = _timed(first, last, poses, here, there)
        if best is None or found[0] < best[0]:
            best = *found, np.concatenate([first[1:], last[1:-1]]), len(first) - 2
    if best is None:
        return None
    steps, lead, delay, via, carried = best
    return Route(base, arm, delay, steps, 0.0, via=via, carried=carried, lead=lead)


def _timed(
    first: np.ndarray, last: np.ndarray, poses: np.ndarray, here: Free, there: Free
) -> tuple[int, int, int]:
    """Choose how far the motions of base and arm may overlap in time.

    Args:
        first: (P, J) path of the arm before the drive.
        last: (P, J) path of the arm after the drive.
        poses: (T, 3) base poses of the drive.
        here: collision-free configurations at the first base pose.
        there: collision-free configurations at the last base pose.

    Returns:
        Total control steps, the step at which the base starts, and the step at which the arm starts its last path.
    """
    before = _along(here.body, first)
    after = _along(here.body, last)
    out = len(before)
    back = len(after)
    drive = len(poses)
    options = [
        (max(lead + drive, delay + back), lead, delay)
        # A few overlaps are enough: a finer choice saves less time than its checks take.
        for lead in {0, out // 2, out}
        for delay in {max(out, lead + drive - share * back // 2) for share in (0, 1, 2)}
    ]
    # One after another is clear for certain, since its parts were checked each.
    late = (out + drive + back, out, out + drive)
    # The first one that is clear is the quickest.
    for steps, lead, delay in sorted(options):
        if (steps, lead, delay) >= late:
            break
        # Forty instants cover a route of some seconds closely enough for its clearances.
        t = np.unique(np.linspace(0, steps, 40).astype(int))
        arm = np.where(
            (t < delay)[:, None],
            before[np.minimum(t, out - 1)],
            after[np.clip(t - delay, 0, back - 1)],
        )
        arm[:, BASE] = poses[np.clip(t - lead, 0, drive - 1)]
        moving = (t > lead) & (t < lead + drive - 1)
        asked = np.where(
            moving, here.drive, np.where(t <= lead, here.clearance, there.clearance)
        )
        gap = np.minimum(
            here.robot.clearance(arm, here.boxes) - asked,
            here.robot.self_clearance(arm) - min(here.own, there.own),
        )
        if (gap >= 0.0).all():
            return steps, lead, delay
    return late


def _along(robot: Robot, path: np.ndarray) -> np.ndarray:
    """Predicted configurations (N, J), one per control step, of an arm that follows the path ``path`` (P, J)."""
    torso = list(robot.torso_columns)
    arm = list(robot.arm_columns)
    delta = robot.limits.joint_delta
    parts = []
    for start, end in pairwise(path):
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


def _arm_paths(
    start: np.ndarray, end: np.ndarray, postures: np.ndarray, here: Free, there: Free
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pairs of arm paths (P, J): from ``start`` (J,) into one of ``postures`` (V, J), and out of it to ``end`` (J,).

    The order of ``postures`` is kept.
    """
    if not len(postures):
        return []
    before = postures.copy()
    after = postures.copy()
    before[:, BASE] = start[BASE]
    after[:, BASE] = end[BASE]
    # A coarse test of all postures at once, before the exact one of single motions.
    out = here.likely(start, before)
    back = there.likely(end, after)
    found = []
    for i in np.flatnonzero(out & back):
        if here.edge(start, before[i]) and there.edge(after[i], end):
            found.append((np.stack([start, before[i]]), np.stack([after[i], end])))
        if len(found) == PATHS_TIMED:
            break
    # RRT-Connect for one of the two paths, for postures whose other path is straight and free.
    for i in np.flatnonzero(out ^ back)[: 0 if found else POSTURES_SEARCHED]:
        # The straight one is checked first where a tree is needed for the other, as it is cheap.
        first = (
            _straight(start, before[i], here)
            if out[i]
            else arm_path(start, before[i], here)
        )
        last = (
            None
            if first is None
            else _straight(after[i], end, there)
            if back[i]
            else arm_path(after[i], end, there)
        )
        if first is not None and last is not None:
            return [(first, last)]
    return found


def _straight(start: np.ndarray, end: np.ndarray, free: Free) -> np.ndarray | None:
    """Straight path (2, J) between two configurations (J,); None if it collides."""
    return np.stack([start, end]) if free.edge(start, end) else None


def _postures(robot: Robot, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Candidate postures (V, J), ordered by the control steps from ``start`` (J,) by way of them to ``end`` (J,)."""
    dofs = ik.columns(robot.chain)
    # Joints that the planner does not move, such as the head, stay as they are.
    others = np.setdiff1d(np.arange(BASE.stop, len(start)), dofs)
    drawn = _library(robot).copy()
    drawn[:, others] = start[others]
    # Both ends are postures, too: often the arm can stay as it is for the drive.
    drawn = np.concatenate([ik.unwind(robot.chain, drawn, start), start[None], end[None]])
    fingers = robot.columns.fingers
    drawn[:, fingers] = start[fingers]
    steps = [ik.travel_steps(robot.chain, q, drawn, dofs) for q in (start, end)]
    return drawn[np.argsort(steps[0] + steps[1], kind="stable")]


@lru_cache(maxsize=8)
def _library(robot: Robot) -> np.ndarray:
    """Sampled postures (V, J) around the rest configuration without self-collisions."""
    drawn = ik.random_seeds(
        robot.chain,
        robot.rest,
        ik.columns(robot.chain),
        4 * MAX_POSTURES,
        # A fixed seed: plans must not depend on how many were made before.
        np.random.default_rng(PLANNING_SEED),
        1.0,
    )
    # Twice the clearance, since the motions into these postures need some as well.
    return drawn[motion.spheres(robot).self_clearance(drawn) > 2 * SELF_CLEARANCE_M][
        :MAX_POSTURES
    ]


def _clear_drives(postures: np.ndarray, poses: np.ndarray, free: Free) -> np.ndarray:
    """Indices of the first `MAX_CLEAR_POSTURES` of postures (V, J) that are free at base poses (T, 3) of a drive."""
    found: list[Any] = []
    # In batches: usually the first one yields enough, and the rest need not be checked.
    for start in range(0, len(postures), 2 * MAX_CLEAR_POSTURES):
        rows = np.arange(start, min(start + 2 * MAX_CLEAR_POSTURES, len(postures)))
        for pose in poses[np.unique(np.linspace(0, len(poses) - 1, _PLACES).astype(int))]:
            q = postures[rows]
            q[:, BASE] = pose
            rows = rows[free.robot.clearance(q, free.boxes) >= free.drive]
        found += list(rows)
        if len(found) >= MAX_CLEAR_POSTURES:
            break
    # With a type, because an empty list would become floats, which are no indices.
    return np.array(found[:MAX_CLEAR_POSTURES], np.int64)
