"""Arm configurations with which the hand reaches one of many poses from one of many base poses, for Pick and Place.

Base poses (`base_poses`) are paired with hand poses; inverse kinematics in one batch, then clearances of the whole
body, cheap tests first. Lengths [m], angles [rad], world frame. Letters: G hand poses, B base poses, N pairs, Q joints.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.joints import BASE, BASE_YAW
from mjhab.envs.parts.world_view import WorldView
from mjhab.episodes.grasps.candidates import Grasps, approach_clearance
from mjhab.experts.arm import ik, motion
from mjhab.experts.base.route import RouteWish, plan_route
from mjhab.experts.planning.base_poses import (
    MAX_OVERREACH_M,
    OUT_CLEARANCE_M,
    base_poses,
    exit_clearance,
    given_poses,
    overreach,
)
from mjhab.experts.planning.workplace import (
    BasePlacement,
    Blocked,
    HandGoals,
    ReachQuery,
    ReachScene,
)
from mjhab.robots.parts import Gripper
from mjhab.robots.robot import Robot

MAX_DEFICIT_M = -0.055
"""Routes with less ``clearance`` than this (negative: a deficit) touch something. `plan_route` counts it from a
margin of 0.045 m on."""
_STRETCHED_PRICE = 60.0
"""Price of a nearly straight elbow [control steps per radian]."""
MAX_PLACEMENTS = 3
"""Number of base placements with a collision-free route after which the search ends."""
_PER_BASE = 8
"""Hand poses that are tried from a base pose."""
_SEEDS = 5
"""Start configurations of the inverse kinematics; the first is the present one."""
_KEPT = 50
"""Configurations without contact after which no more are checked."""


def placements(
    view: WorldView, query: ReachQuery, blocked: list[Blocked] | None = None
) -> list[BasePlacement]:
    """At most `MAX_PLACEMENTS` ways to bring the hand to one of the requested poses, quickest first.

    Args:
        view: world to plan in.
        query: the request.
        blocked: if given, hand poses that can be reached but have no collision-free route are appended, for
            `sampled.clearer`.
    """
    bases, drive = (
        base_poses(view, query)
        if query.bases is None
        else given_poses(view, query, query.bases)
    )
    if not len(bases):
        return []
    if query.drive_in and len(query.scene.target):
        out = exit_clearance(bases, query.scene, query.drive_in)
        # Where no base pose has the clearance, those with nearly the most are kept.
        rows = np.flatnonzero(out > min(OUT_CLEARANCE_M, float(out.max()) - 0.005))
        bases = bases[rows]
        drive = drive[rows]
    base, goal, score = _pairs(view.robot, bases, query.point, query.goals)
    if not len(base):
        return []
    price = drive[base] - 10.0 * score
    q, goal = _configurations(view, query, bases[base], goal, price)
    rows = clear_ones(q, query.scene, query.clearance)
    q = q[rows]
    goal = goal[rows]
    pre, fine = _before(q, goal, query)
    q = q[fine]
    pre = pre[fine]
    goal = goal[fine]
    found = _routed(view, query, q, pre, goal)
    if blocked is not None and len(q) and not (found and found[0].route.clearance >= 0.0):
        blocked.append(Blocked(query.goals, goal, pre, q, query.scene, query.drive_in))
    return found


def clear_ones(q: np.ndarray, scene: ReachScene, clearance: float) -> np.ndarray:
    """Indices of at most `_KEPT` of the configurations ``q`` (N, J), in order, that keep a ``clearance`` [m].

    Arm and held object are checked. The hand is not, see `hand_clearance`.
    """
    whole = motion.spheres(scene.body)
    hand_links = scene.body.hand_links
    arm = whole.only([n for n in whole.chain.links if n not in hand_links])
    load = None if scene.held is None else whole.only([]).with_held(*scene.held)
    found: list[np.ndarray] = []
    # In blocks: the cheap ones come first, and often enough of them are clear.
    for start in range(0, len(q), _KEPT):
        rows = np.arange(start, min(start + _KEPT, len(q)))
        rows = rows[arm.clearance(q[rows], scene.near) > clearance]
        rows = rows[whole.self_clearance(q[rows]) > clearance] if len(rows) else rows
        if load is not None and len(rows):
            rows = rows[load.clearance(q[rows], scene.beside) > -0.004]
        found.append(rows)
        if sum(map(len, found)) >= _KEPT:
            break
    return np.concatenate(found)[:_KEPT] if found else np.zeros(0, np.int64)


def hand_clearance(
    gripper: Gripper, goals: HandGoals | Grasps, boxes: Boxes
) -> np.ndarray:
    """Clearance (G,) [m] of hand and wrist from boxes on the straight approach to the goals."""
    hand = approach_clearance(
        goals.pos, goals.rot, goals.opening, goals.pre, boxes, gripper
    )
    back = 0.05 * goals.rot[:, :, 0]
    wrist = approach_clearance(
        goals.pos - back, goals.rot, goals.opening, goals.pre - back, boxes, gripper
    )
    return np.minimum(hand, wrist)


def _pairs(
    robot: Robot, bases: np.ndarray, point: np.ndarray, goals: HandGoals
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of base poses (B, 3) and the `_PER_BASE` hand poses that suit each best.

    Returns:
        (N,) index of the base pose, (N,) index of the hand pose, (N,) score.
    """
    toward = point[:2] - bases[:, :2]
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-6)
    score = goals.score + 0.8 * toward @ goals.rot[:, :2, 0].T
    over = overreach(robot.reach, bases, goals)
    score = np.where(
        over < MAX_OVERREACH_M, score - 20.0 * np.maximum(over, 0.0), -np.inf
    )
    # Among equal hand poses every base pose tries different ones.
    score = score + 0.05 * np.random.default_rng(1).random(score.shape)
    best = np.argsort(-score, axis=1, kind="stable")[:, :_PER_BASE]
    base = np.repeat(np.arange(len(bases)), best.shape[1])
    goal = best.ravel()
    found = np.isfinite(score[base, goal])
    return base[found], goal[found], score[base, goal][found]


@lru_cache(maxsize=8)
def _seeds(robot: Robot) -> np.ndarray:
    """Arm and torso configurations (S, J) to start inverse kinematics from."""
    dofs = ik.columns(robot.chain)
    random = np.random.default_rng(3)
    return ik.random_seeds(robot.chain, robot.rest, dofs, _SEEDS, random, 0.6)


def _configurations(
    view: WorldView,
    query: ReachQuery,
    bases: np.ndarray,
    goal: np.ndarray,
    price: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Configurations that reach hand poses from base poses, cheapest first.

    Args:
        view: world to plan in.
        query: the request.
        bases: (P, 3) base poses.
        goal: (P,) index of the hand pose of every base pose.
        price: (P,) control steps to drive there, minus the value of the hand pose.

    Returns:
        (N, J) configurations, and (N,) the index of the hand pose of each.
    """
    body = view.robot
    now = view.q
    goals = query.goals
    robot = body.chain
    dofs = ik.columns(robot)
    seeds = np.repeat(_seeds(body)[None], len(bases), axis=0)
    seeds[:, :, BASE] = bases[:, None]
    # The present posture first: what is near it takes least time.
    seeds[:, 0, BASE.stop :] = now[BASE.stop :]
    options = ik.Options(iterations=25, pos_tolerance=2e-3, rot_tolerance=2e-2)
    found = ik.solve(
        robot,
        ik.TipGoals(goals.pos[goal], goals.rot[goal], dofs, body.rest),
        seeds,
        options=options,
    )
    q = ik.unwind(robot, found.q, now)
    q[..., BASE] = bases[:, None]
    cost = price[:, None] + 0.6 * ik.travel_steps(robot, now, q, dofs)
    if query.home:
        cost = cost + query.home * motion.steps_home(body, q)
    # A stretched arm cannot correct an error of the base pose.
    cost = cost + _STRETCHED_PRICE * np.maximum(
        0.0, 0.9 - np.abs(q[..., body.elbow_column])
    )
    cost = np.where(found.ok, cost, np.inf).ravel()
    # Cheapest first, and no more than can be checked in time.
    order = np.argsort(cost, kind="stable")[:300]
    order = order[np.isfinite(cost[order])]
    q = q.reshape(-1, q.shape[-1])[order]
    goal = np.repeat(goal, seeds.shape[1])[order]
    # Clearances are checked with the hand as open as it will be.
    fingers = np.minimum(goals.opening[goal] / 2, body.finger_max)
    q[:, body.columns.fingers] = fingers[:, None]
    return q, goal


def _before(
    q: np.ndarray, goal: np.ndarray, query: ReachQuery
) -> tuple[np.ndarray, np.ndarray]:
    """Configurations (N, J) at the start of the straight approach, and whether (N,) they and the drive in are clear.

    The torso is already at its final height, because it follows small changes too slowly.
    """
    if not len(q):
        return q, np.zeros(0, bool)
    scene = query.scene
    goals = query.goals
    robot = scene.body.chain
    dofs = ik.columns(robot, torso=False)
    options = ik.Options(
        iterations=12, pos_tolerance=2e-3, rot_tolerance=2e-2, rest_gain=0.0
    )
    found = ik.solve(
        robot,
        ik.TipGoals(goals.pre[goal], goals.rot[goal], dofs, scene.body.rest),
        q[:, None],
        options=options,
    )
    pre = found.q[:, 0]
    fine = found.ok[:, 0] & (np.abs(pre - q).max(axis=1) < 0.9)
    whole = scene.robot()
    hand_links = scene.body.hand_links
    hand = whole.only(hand_links)
    arm = whole.only([n for n in whole.chain.links if n not in hand_links])
    for back in np.arange(0.0, query.drive_in + 0.01, 0.12):
        shifted = pre[fine].copy()
        shifted[:, 0] -= back * np.cos(shifted[:, 2])
        shifted[:, 1] -= back * np.sin(shifted[:, 2])
        # At its work the hand is close by intention; on the drive in nothing may be.
        if back == 0.0:
            clearance = np.minimum(
                arm.clearance(shifted, scene.all), whole.self_clearance(shifted)
            )
            clearance = np.minimum(
                clearance, hand.clearance(shifted, scene.all) + query.nearer
            )
        else:
            clearance = whole.clearance(shifted, scene.all)
        fine[fine] = clearance > query.clearance
    return pre, fine


def _routed(
    view: WorldView, query: ReachQuery, q: np.ndarray, pre: np.ndarray, goal: np.ndarray
) -> list[BasePlacement]:
    """Base placements with collision-free routes to ``pre`` (N, J); if there are none, the one with the most clearance.

    ``q`` (N, J), ``goal`` (N,): configurations at the hand poses, cheapest first, and indices of the hand poses.
    """
    scene = query.scene
    robot = scene.robot()
    boxes = scene.all
    clear: list[BasePlacement] = []
    tight: list[BasePlacement] = []
    seen: list[np.ndarray] = []
    for i in range(len(q)):
        # Other base poses differ more than further postures at the same one.
        if sum(np.array_equal(q[i, BASE], base) for base in seen) >= 2:
            continue
        seen.append(q[i, BASE])
        back = query.drive_in * motion.ahead_3d(pre[i, BASE_YAW])
        route = plan_route(
            view,
            pre[i, BASE] - back,
            pre[i],
            robot,
            boxes,
            RouteWish(limits=scene.limits),
        )
        if route is None:
            continue
        (clear if route.clearance >= 0.0 else tight).append(
            BasePlacement(int(goal[i]), pre[i], q[i], route)
        )
        # The cheapest one from there: how long the way from here takes does not matter.
        if clear and query.start is not None:
            break
        if len(clear) >= MAX_PLACEMENTS or len(clear) + len(tight) >= 3 * MAX_PLACEMENTS:
            break
    tight = sorted(
        (s for s in tight if s.route.clearance > MAX_DEFICIT_M),
        key=lambda s: -s.route.clearance,
    )

    def steps(placement: BasePlacement) -> float:
        back = float(motion.steps_home(view.robot, placement.at))
        return placement.route.steps + query.home * back

    # One that is tight at most: trying several costs the time of the episode.
    return sorted(clear, key=steps) or tight[:1]


def settle_reach(
    view: WorldView, placement: BasePlacement, pos: np.ndarray, rot: np.ndarray
) -> np.ndarray | None:
    """Configurations for hand positions from the actual base pose, which differs from the planned one.

    All have the same torso height, the planned one if possible.

    Args:
        view: world to act in.
        placement: planned configurations.
        pos: (M, 3) hand positions.
        rot: (3, 3) rotation of the hand.

    Returns:
        (M, J); None if a position is out of reach.
    """
    robot = view.robot.chain
    torso = list(view.robot.torso_columns)
    arm = ik.columns(robot, torso=False)
    # The torso only where the arm alone does not reach: it is slow.
    for free in (arm, ik.columns(robot)):
        seed = np.stack([placement.pre, placement.at])
        seed[:, BASE] = view.base
        first = ik.solve(robot, ik.TipGoals(pos[:1], rot[None], free, placement.at), seed)
        for start in first.q[0, first.ok[0]]:
            seeds = np.concatenate([start[None], seed])
            seeds[:, torso] = start[torso]
            found = ik.solve(
                robot,
                ik.TipGoals(pos, np.repeat(rot[None], len(pos), axis=0), arm, start),
                seeds,
            )
            if found.ok.any(axis=1).all():
                gap = np.abs(found.q - start).max(axis=-1)
                return ik.unwind(robot, found.best(gap)[0], view.q)
    return None
