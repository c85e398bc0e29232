"""Arm configurations with which the hand reaches one of many poses from one of many base poses, for Pick and Place.

Base poses (`base_poses`) are paired with hand poses; inverse kinematics in one batch, then clearances of the whole
body, cheap tests first. Lengths [m], angles [rad], world frame. Letters: G hand poses, B base poses, N pairs, Q joints.
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
    overreach,
    way_out,
)
from mjhab.experts.planning.workplace import Blocked, HandGoals, Scene, Stance, Work
from mjhab.robots.parts import Gripper
from mjhab.robots.robot import Robot

Array = np.ndarray
MAX_DEFICIT_M = -0.055
"""Routes whose room is less than this (negative: a deficit) touch something. `plan_route` counts room from a margin of
0.045 m on."""
_STRETCHED_PRICE = 60.0
"""Price of a nearly straight elbow [control steps per radian]."""
MAX_STANCES = 3
_PER_BASE = 8
_SEEDS = 5
_KEPT = 50


def stances(view: WorldView, work: Work, blocked: list[Blocked] | None = None) -> list[Stance]:
    """Ways to bring the hand to its work, quickest first, at most MAX_STANCES; empty when there is none.

    Args:
        blocked: what lacks nothing but a clear way is added here, for `sampled.roomier`.
    """
    bases, drive = base_poses(view, work)
    if not len(bases):
        return []
    if work.drive_in and len(work.scene.target):
        out = way_out(bases, work.scene, work.drive_in)
        rows = np.flatnonzero(out > min(OUT_CLEARANCE_M, float(out.max()) - 0.005))
        bases = bases[rows]
        drive = drive[rows]
    base, goal, score = _pairs(view.robot, bases, work.point, work.goals)
    if not len(base):
        return []
    price = drive[base] - 10.0 * score
    q, goal = _configurations(view, work, bases[base], goal, price)
    rows = clear_ones(q, work.scene, work.room)
    q = q[rows]
    goal = goal[rows]
    pre, fine = _before(q, goal, work)
    q = q[fine]
    pre = pre[fine]
    goal = goal[fine]
    found = _routed(view, work, q, pre, goal)
    if blocked is not None and len(q) and not (found and found[0].route.room >= 0.0):
        blocked.append(Blocked(work.goals, goal, pre, q, work.scene, work.drive_in))
    return found


def clear_ones(q: Array, scene: Scene, room: float) -> Array:
    """The first few (indices) of the configurations (N, J) that touch nothing; the hand is looked at elsewhere."""
    whole = motion.spheres(scene.body)
    hand_links = scene.body.hand_links
    arm = whole.only([n for n in whole.chain.links if n not in hand_links])
    load = None if scene.held is None else whole.only([]).with_held(*scene.held)
    found: list[Array] = []
    for start in range(0, len(q), _KEPT):
        rows = np.arange(start, min(start + _KEPT, len(q)))
        rows = rows[arm.clearance(q[rows], scene.near) > room]
        rows = rows[whole.self_clearance(q[rows]) > room] if len(rows) else rows
        if load is not None and len(rows):
            rows = rows[load.clearance(q[rows], scene.beside) > -0.004]
        found.append(rows)
        if sum(map(len, found)) >= _KEPT:
            break
    return np.concatenate(found)[:_KEPT] if found else np.zeros(0, np.int64)


def hand_room(gripper: Gripper, goals: HandGoals | Grasps, boxes: Boxes) -> Array:
    """Clearance (G,) of the hand and of the wrist behind it on the straight way to the goals."""
    hand = approach_clearance(goals.pos, goals.rot, goals.opening, goals.pre, boxes, gripper)
    back = 0.05 * goals.rot[:, :, 0]
    wrist = approach_clearance(
        goals.pos - back, goals.rot, goals.opening, goals.pre - back, boxes, gripper
    )
    return np.minimum(hand, wrist)


def _pairs(
    robot: Robot, bases: Array, point: Array, goals: HandGoals
) -> tuple[Array, Array, Array]:
    """For every base the hand poses that suit it best: base index (N,), goal index (N,), score (N,)."""
    toward = point[:2] - bases[:, :2]
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-6)
    score = goals.score + 0.8 * toward @ goals.rot[:, :2, 0].T
    over = overreach(robot.reach, bases, goals)
    score = np.where(over < MAX_OVERREACH_M, score - 20.0 * np.maximum(over, 0.0), -np.inf)
    # Among equals every base tries others.
    score = score + 0.05 * np.random.default_rng(1).random(score.shape)
    best = np.argsort(-score, axis=1, kind="stable")[:, :_PER_BASE]
    base = np.repeat(np.arange(len(bases)), best.shape[1])
    goal = best.ravel()
    found = np.isfinite(score[base, goal])
    return base[found], goal[found], score[base, goal][found]


@lru_cache(maxsize=8)
def _seeds(robot: Robot) -> Array:
    """Arm and torso configurations (S, J) to start inverse kinematics from."""
    dofs = ik.columns(robot.chain)
    random = np.random.default_rng(3)
    return ik.random_seeds(robot.chain, robot.rest, dofs, _SEEDS, random, 0.6)


def _configurations(
    view: WorldView, work: Work, bases: Array, goal: Array, price: Array
) -> tuple[Array, Array]:
    """Configurations (N, J) that reach hand poses ``goal`` (P,) from ``bases`` (P, 3), and their goal (N,).

    The quickest come first; ``price`` (P,): control steps to drive there, less the worth of the hand pose.
    """
    body = view.robot
    now = view.q
    goals = work.goals
    robot = body.chain
    dofs = ik.columns(robot)
    seeds = np.repeat(_seeds(body)[None], len(bases), axis=0)
    seeds[:, :, BASE] = bases[:, None]
    seeds[:, 0, BASE.stop :] = now[BASE.stop :]
    options = ik.Options(iterations=25, pos_tolerance=2e-3, rot_tolerance=2e-2)
    found = ik.solve(
        robot, goals.pos[goal], goals.rot[goal], seeds, dofs, rest=body.rest, options=options
    )
    q = ik.unwind(robot, found.q, now)
    q[..., BASE] = bases[:, None]
    cost = price[:, None] + 0.6 * ik.travel_steps(robot, now, q, dofs)
    if work.home:
        cost = cost + work.home * motion.steps_home(body, q)
    # A stretched arm cannot make up for a base that stands a little wrong.
    cost = cost + _STRETCHED_PRICE * np.maximum(0.0, 0.9 - np.abs(q[..., body.elbow_column]))
    cost = np.where(found.ok, cost, np.inf).ravel()
    order = np.argsort(cost, kind="stable")[:300]
    order = order[np.isfinite(cost[order])]
    q = q.reshape(-1, q.shape[-1])[order]
    goal = np.repeat(goal, seeds.shape[1])[order]
    fingers = np.minimum(goals.opening[goal] / 2, body.finger_max)
    q[:, body.columns.fingers] = fingers[:, None]
    return q, goal


def _before(q: Array, goal: Array, work: Work) -> tuple[Array, Array]:
    """Configurations (N, J) at the start of the straight approach, and where they and the way in are clear (N,).

    The torso is at its final height already: it is too slow for fine work.
    """
    if not len(q):
        return q, np.zeros(0, bool)
    scene = work.scene
    goals = work.goals
    robot = scene.body.chain
    dofs = ik.columns(robot, torso=False)
    options = ik.Options(iterations=12, pos_tolerance=2e-3, rot_tolerance=2e-2, rest_gain=0.0)
    found = ik.solve(
        robot,
        goals.pre[goal],
        goals.rot[goal],
        q[:, None],
        dofs,
        rest=scene.body.rest,
        options=options,
    )
    pre = found.q[:, 0]
    fine = found.ok[:, 0] & (np.abs(pre - q).max(axis=1) < 0.9)
    whole = scene.robot()
    hand_links = scene.body.hand_links
    hand = whole.only(hand_links)
    arm = whole.only([n for n in whole.chain.links if n not in hand_links])
    for back in np.arange(0.0, work.drive_in + 0.01, 0.12):
        shifted = pre[fine].copy()
        shifted[:, 0] -= back * np.cos(shifted[:, 2])
        shifted[:, 1] -= back * np.sin(shifted[:, 2])
        if back == 0.0:
            room = np.minimum(arm.clearance(shifted, scene.all), whole.self_clearance(shifted))
            room = np.minimum(room, hand.clearance(shifted, scene.all) + work.nearer)
        else:
            room = whole.clearance(shifted, scene.all)
        fine[fine] = room > work.room
    return pre, fine


def _routed(view: WorldView, work: Work, q: Array, pre: Array, goal: Array) -> list[Stance]:
    """Stances with routes that are clear; ``q`` (N, J) come cheapest first."""
    scene = work.scene
    robot = scene.robot()
    boxes = scene.all
    clear: list[Stance] = []
    tight: list[Stance] = []
    seen: list[Array] = []
    for i in range(len(q)):
        if sum(np.array_equal(q[i, BASE], base) for base in seen) >= 2:
            continue
        seen.append(q[i, BASE])
        back = work.drive_in * np.array([np.cos(pre[i, BASE_YAW]), np.sin(pre[i, BASE_YAW]), 0.0])
        route = plan_route(
            view, pre[i, BASE] - back, pre[i], robot, boxes, RouteWish(care=scene.care)
        )
        if route is None:
            continue
        (clear if route.room >= 0.0 else tight).append(Stance(int(goal[i]), pre[i], q[i], route))
        if len(clear) >= MAX_STANCES or len(clear) + len(tight) >= 3 * MAX_STANCES:
            break
    tight = sorted((s for s in tight if s.route.room > MAX_DEFICIT_M), key=lambda s: -s.route.room)

    def steps(stance: Stance) -> float:
        back = float(motion.steps_home(view.robot, stance.at))
        return stance.route.steps + work.home * back

    return sorted(clear, key=steps) or tight[:1]


def settle_reach(view: WorldView, stance: Stance, pos: Array, rot: Array) -> Array | None:
    """Configurations (M, J) for hand positions (M, 3) from where the base really stands; one torso height for all,
    the planned one if possible.

    None when one of them is out of reach from here.
    """
    robot = view.robot.chain
    torso = list(view.robot.torso_columns)
    arm = ik.columns(robot, torso=False)
    for free in (arm, ik.columns(robot)):
        seed = np.stack([stance.pre, stance.at])
        seed[:, BASE] = view.base
        first = ik.solve(robot, pos[:1], rot[None], seed, free, rest=stance.at)
        for start in first.q[0, first.ok[0]]:
            seeds = np.concatenate([start[None], seed])
            seeds[:, torso] = start[torso]
            found = ik.solve(
                robot, pos, np.repeat(rot[None], len(pos), axis=0), seeds, arm, rest=start
            )
            if found.ok.any(axis=1).all():
                gap = np.abs(found.q - start).max(axis=-1)
                return ik.unwind(robot, found.best(gap)[0], view.q)
    return None
