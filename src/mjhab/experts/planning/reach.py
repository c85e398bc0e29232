"""Base poses and arm configurations with which the hand reaches one of many poses, for Pick and Place.

Base poses around a point are paired with hand poses; inverse kinematics in one batch, then clearances of the whole
body, cheap tests first. Lengths [m], angles [rad], world frame. Letters: G hand poses, B base poses, N pairs, Q joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mjhab.core.boxes import Boxes, nearest_box_distance
from mjhab.core.joints import BASE, BASE_YAW
from mjhab.envs.parts.world_view import WorldView
from mjhab.episodes.grasps.candidates import Grasps, approach_clearance
from mjhab.experts.arm import ik, motion
from mjhab.experts.arm.clearance import RobotSpheres
from mjhab.experts.arm.gentle import Care
from mjhab.experts.base.route import Route, RouteWish, drive_steps, plan_route, planner
from mjhab.robots.kinematics import wrap
from mjhab.robots.parts import Gripper
from mjhab.robots.robot import ArmReach, Footprint, Robot

Array = np.ndarray
NEARBY_M = 2.6
"""Furniture within this distance of the work is checked for collisions."""
CLEARANCES_M = (0.012, 0.006, 0.0)
"""Least clearance of the arm at the work, and of the whole robot just before it, in the first, second and later
attempts."""
MAX_DEFICIT_M = -0.055
"""Routes whose room is less than this (negative: a deficit) touch something. `plan_route` counts room from a margin of
0.045 m on."""
OUT_CLEARANCE_M = 0.03
"""Least clearance of an object on its straight way out of a shelf."""
FAR_BASE_M = 0.96
"""Base poses farther than this from the work, or in narrow places, are only taken where there are no others."""
MAX_OVERREACH_M = 0.05
"""Greatest distance of the wrist beyond the comfortable one, see `_overreach`."""
_STRETCHED_PRICE = 60.0
"""Price of a nearly straight elbow [control steps per radian]."""
MAX_STANCES = 3
_BASES = 24
_PER_BASE = 8
_SEEDS = 5
_KEPT = 50


@dataclass(frozen=True, eq=False)
class HandGoals:
    """Hand poses, any of which will do: ``pos`` (G, 3), ``rot`` (G, 3, 3), where to come from ``pre`` (G, 3), finger
    ``opening`` (G,) and ``score`` (G,), higher is better, worth about half a second each point."""

    pos: Array
    rot: Array
    pre: Array
    opening: Array
    score: Array

    def __len__(self) -> int:
        return len(self.pos)

    def take(self, rows: Array) -> HandGoals:
        """Some of them, by index."""
        return HandGoals(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class Scene:
    """Obstacles and robot around a work place.

    near: boxes of everything but the object. target: boxes of the object, empty while it is held. support_z: height of
    the surface that the object lies on or goes to [m]. body: the robot. held: centres and radii [m] of spheres that
    cover the held object, in the frame of the hand. care: limits of the motion for a held object.
    """

    near: Boxes
    target: Boxes
    support_z: float
    body: Robot
    held: tuple[Array, Array] | None = None
    care: Care | None = None

    @property
    def all(self) -> Boxes:
        """Every box."""
        return Boxes.join([self.near, self.target])

    @property
    def beside(self) -> Boxes:
        """Boxes of ``near`` that rise above the supporting surface."""
        top = self.near.center[:, 2] + np.einsum(
            "kj,kj->k", np.abs(self.near.rot[:, 2]), self.near.half
        )
        return self.near.take(top > self.support_z + 0.004)

    def robot(self) -> RobotSpheres:
        """Spheres of the arm and of the held object."""
        arm = motion.arm_spheres(self.body)
        return arm if self.held is None else arm.with_held(*self.held)


@dataclass(frozen=True, eq=False)
class Stance:
    """A way to reach hand pose ``goal`` (index): drive ``route``, then configurations ``pre`` and ``at`` (J,)."""

    goal: int
    pre: Array
    at: Array
    route: Route


@dataclass(frozen=True, eq=False)
class Blocked:
    """Hand poses that the arm can reach, but without a collision-free straight motion from ``pre`` to ``at``.

    goals: all hand poses. goal: (N,) indices into ``goals``, best first. pre, at: (N, J) joint configurations before
    and at each hand pose. scene: obstacles. drive_in: distance of the straight drive at the end [m].
    """

    goals: HandGoals
    goal: Array
    pre: Array
    at: Array
    scene: Scene
    drive_in: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Work:
    """A request for a base pose, an arm motion and a route.

    Attributes:
        point: (3,) point near which the base stands [m].
        goals: hand poses, of which one is reached.
        scene: obstacles and robot.
        drive_in: distance [m] that the base drives straight forward at the end, with the arm already stretched out, for
            instance into a fridge. The route ends at this distance before the work place.
        avoid: (A, 3) base poses from which an earlier attempt failed.
        room: least clearance [m] at the work, see `CLEARANCES_M`.
        nearer: how much nearer [m] than that the hand may come just before its work.
        home: weight of the control steps from the work back to rest.
        far: stand far off even where one may stand nearer: that can save a long way.
    """

    point: Array
    goals: HandGoals
    scene: Scene
    drive_in: float = 0.0
    avoid: Array | None = None
    room: float = CLEARANCES_M[0]
    nearer: float = 0.0
    home: float = 0.0
    far: bool = False


def surroundings(view: WorldView, obj: str, point: Array) -> tuple[Boxes, Boxes]:
    """Everything solid near ``point`` (3,) but the object, and the object's bounding box."""
    parts = (view.home.boxes, view.link_boxes(), view.object_boxes((obj,)))
    others = Boxes.join(parts)
    everything = view.object_boxes()
    mine = np.array([view.object_names.index(obj)])
    return others.near(np.array([*point[:2], 0.9]), NEARBY_M), everything.take(mine)


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


def way_out(bases: Array, scene: Scene, drive_in: float) -> Array:
    """Room (B,) of the object, a little lifted, while bases (B, 3) drive straight back with it."""
    box = scene.target
    half = scene.target.half[0]
    size = float(half.min())
    axes = [
        np.linspace(-h + size, h - size, 1 + int(np.ceil(2 * (h - size) / (1.3 * size))))
        for h in half
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points = box.center[0] + grid @ box.rot[0].T + np.array([0.0, 0.0, 0.025])
    ahead = np.stack([np.cos(bases[:, 2]), np.sin(bases[:, 2]), np.zeros(len(bases))], axis=1)
    share = np.linspace(0.0, drive_in, 7)
    moved = points - share[None, :, None, None] * ahead[:, None, None]
    gap = nearest_box_distance(moved.reshape(-1, 3), scene.beside.near(box.center[0], 0.9))
    return gap.reshape(len(bases), -1).min(axis=1) - size


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


def base_poses(view: WorldView, work: Work) -> tuple[Array, Array]:
    """Base poses (B, 3) from which a goal may be reached, and the control steps (B,) to drive there."""
    point = work.point
    drive_in = work.drive_in
    r, angle, off = np.meshgrid(
        np.arange(0.5, 1.26, 0.075), np.arange(32) * np.pi / 16, (-0.35, 0.0, 0.35), indexing="ij"
    )
    x = point[0] - r * np.cos(angle)
    y = point[1] - r * np.sin(angle)
    poses = np.stack([x, y, wrap(angle + off)], axis=-1).reshape(-1, 3)
    here = view.base - drive_in * np.array([np.cos(view.base[2]), np.sin(view.base[2]), 0.0])
    bearing = np.arctan2(point[1] - here[1], point[0] - here[0])
    poses = np.concatenate(
        [poses, [view.base, *([here[0], here[1], bearing + k] for k in (-0.35, 0.0, 0.35))]]
    )
    far_off = np.append(r.ravel() > FAR_BASE_M, np.zeros(4, bool))
    cells = planner(view)
    back = poses[:, :2] - drive_in * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    far_off |= cells.clearance_at(back) < cells.radius
    good = np.minimum(cells.clearance_at(back), cells.clearance_at(poses[:, :2])) >= cells.narrow
    good &= floor_room(view.robot.footprint, poses, work.scene.near) > 0.0
    if work.avoid is not None and len(work.avoid):
        gap = np.linalg.norm((poses[:, None] - work.avoid) * [1.0, 1.0, 0.3], axis=2).min(axis=1)
        good &= gap > 0.10
    good[good] = in_sight(poses[good], point, work.scene.near)
    poses = poses[good]
    back = back[good]
    far_off = far_off[good]
    way = cells.costs(view.base[:2])[cells.cells(back)]
    steps = (
        drive_steps(view.base, np.concatenate([back, poses[:, 2:]], axis=1), way)
        + 6.0 * drive_in / 0.3
    )
    # The nearest bases may all stand on the side from which nothing can be reached.
    reachable = np.isfinite(steps) & (
        _overreach(view.robot.reach, poses, work.goals) < MAX_OVERREACH_M
    ).any(axis=1)
    reachable &= ~far_off | work.far | ~(reachable & ~far_off).any()
    return _spread(poses[reachable], steps[reachable])


def in_sight(poses: Array, point: Array, boxes: Boxes) -> Array:
    """Whether no wall or tall piece stands between base poses (B, 2+) and ``point`` (3,)."""
    top = boxes.center[:, 2] + np.einsum("kj,kj->k", np.abs(boxes.rot[:, 2]), boxes.half)
    tall = boxes.take((top > point[2] + 0.5) & (boxes.half.max(axis=1) > 0.4))
    if not len(poses) or not len(tall):
        return np.ones(len(poses), bool)
    share = np.linspace(0.1, 0.9, 8)[:, None, None]
    line = poses[:, :2] + share * (point[:2] - poses[:, :2])
    height = np.full((*line.shape[:2], 1), point[2] + 0.15)
    gap = nearest_box_distance(np.concatenate([line, height], axis=2).reshape(-1, 3), tall)
    return gap.reshape(len(share), len(poses)).min(axis=0) > 0.02


def floor_room(footprint: Footprint, poses: Array, boxes: Boxes) -> Array:
    """Room (B,) between the base at poses (B, 3) and boxes on the floor that no map knows: things that fell."""
    low = boxes.take(
        (boxes.center[:, 2] - boxes.half.max(axis=1) < footprint.top)
        & (boxes.half.max(axis=1) < 0.12)
    )
    if not len(low):
        return np.ones(len(poses))
    gap = np.linalg.norm(poses[:, None, :2] - low.center[:, :2], axis=2) - low.half[:, :2].max(
        axis=1
    )
    return gap.min(axis=1) - footprint.radius


def _spread(poses: Array, steps: Array) -> tuple[Array, Array]:
    """The quickest poses that are not all alike."""
    kept: list[int] = []
    for i in np.argsort(steps, kind="stable"):
        if len(kept) >= _BASES:
            break
        gap = (poses[kept] - poses[i]) * [1.0, 1.0, 0.3]
        if not kept or np.linalg.norm(gap, axis=1).min() > 0.09:
            kept.append(int(i))
    return poses[kept], steps[kept]


def _pairs(
    robot: Robot, bases: Array, point: Array, goals: HandGoals
) -> tuple[Array, Array, Array]:
    """For every base the hand poses that suit it best: base index (N,), goal index (N,), score (N,)."""
    toward = point[:2] - bases[:, :2]
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-6)
    score = goals.score + 0.8 * toward @ goals.rot[:, :2, 0].T
    over = _overreach(robot.reach, bases, goals)
    score = np.where(over < MAX_OVERREACH_M, score - 20.0 * np.maximum(over, 0.0), -np.inf)
    # Among equals every base tries others.
    score = score + 0.05 * np.random.default_rng(1).random(score.shape)
    best = np.argsort(-score, axis=1, kind="stable")[:, :_PER_BASE]
    base = np.repeat(np.arange(len(bases)), best.shape[1])
    goal = best.ravel()
    found = np.isfinite(score[base, goal])
    return base[found], goal[found], score[base, goal][found]


def _overreach(reach: ArmReach, bases: Array, goals: HandGoals) -> Array:
    """How far (B, G) [m] the wrist is beyond a comfortable distance from the shoulder; 0.05 is the arm's end."""
    wrist = goals.pos - reach.hand * goals.rot[:, :, 0]
    shoulder = bases[:, :2] + reach.ahead * np.stack(
        [np.cos(bases[:, 2]), np.sin(bases[:, 2])], axis=1
    )
    level = np.linalg.norm(wrist[:, :2] - shoulder[:, None], axis=2) - reach.out
    height = np.maximum(np.maximum(reach.low - wrist[:, 2], wrist[:, 2] - reach.high), 0.0)
    return np.hypot(np.maximum(level, 0.0), height) - reach.length


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
