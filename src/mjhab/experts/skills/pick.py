"""The expert for Pick: from tables and seats, out of the opened drawer, from the shelf of the fridge."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.joints import BASE, BASE_XY
from mjhab.core.rotations import mat_from_quat
from mjhab.envs.parts.world_view import WorldView
from mjhab.episodes.grasps.candidates import (
    Grasps,
    LyingObject,
    ObjectShape,
    Options,
    grasp_candidates,
)
from mjhab.experts.arm import motion
from mjhab.experts.arm.motion import Motion
from mjhab.experts.base.route import BLOCKED_FORCE_N, follow, holds
from mjhab.experts.planning.carry import (
    HASTY_SPEED_M_S,
    OUT_SPEED_M_S,
    SHELF_DEPTH_M,
    ReachIn,
    drive_in,
    drive_out,
    go_home,
    grip,
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
from mjhab.experts.planning.sampled import roomier
from mjhab.experts.skills.nudge import in_steps, nudge, plan_nudge
from mjhab.experts.style import of_kind, style_of, wait_for
from mjhab.tasks.style import ANY

Array = np.ndarray
INSIDE_M = 0.06
"""Distance that the base has driven in from which on it is driven out again."""
LIFT_M = 0.10
"""Height by which an object is lifted off an open surface before it is carried."""
SHELF_LIFT_M = 0.025
"""The same on a shelf."""
LATE_IN_STEPS = 130
"""With fewer control steps left, the base hurries into a shelf."""
LATE_OUT_STEPS = 60
"""With fewer control steps left, the base hurries out of a shelf."""
FINE_OPENING_M = 0.094
"""Openings of the hand from which on there are less than 3 mm of free space on either side of the object."""
FINE_CLOSING_M = 0.004
"""Motion per control step of fingers that close on a can beside its axis: an impact would shoot it out of the hand."""
MAX_SHORT_M = 0.025
"""A hand that stops farther than this from its grasp does not close."""
WAIT_STEPS = (5, 10, 20, 50)
"""Control steps to wait after the first, second, ... attempt without a way: things may come to rest meanwhile."""
MAX_GOALS = 60
FREE_OFFSET_M = 0.015
"""Distance of the object's centre beside the pads that costs nothing. Farther off, its weight turns the object
between the pads, and it slips out when something pushes it from above."""
OFFSET_PRICE_PER_M = 15.0
"""Score lost per metre beyond `FREE_OFFSET_M`."""
_CLEAR = ((0.010, -0.008, 0.0), (0.0, -0.02, 0.010), (-0.004, -0.03, 0.014))
"""Room [m] asked between gripper and neighbours, on a shelf also with its wrist (the spheres that stand for it are up
to 8 mm too large), and how much nearer than the arm the hand may come; less each time no good way is found."""
OPTIONS = Options(palm_gap=0.012, floor_gap=0.008, least_clear_m=_CLEAR[-1][0])
# Little room: closer steps around the object, a short way in, and boxes nearly as wide as the hand opens. Below a low
# shelf, where there is no way from above, bowls are taken by the rim from the front.
SHELF_OPTIONS = replace(OPTIONS, fan=36, shallower=(0.0, 0.02), retreat=0.06, cells=31, scant=150.0)
LOW_SHELF_OPTIONS = replace(SHELF_OPTIONS, leans=(0.4, 0.6, 0.8))
SHELF_BLUNT_M = 0.004
"""End of the pads [m] that does not count there."""
MAX_NUDGES = 2
"""How often an object is turned."""
NUDGE_STEPS = 115
"""Control steps that must be left to turn it."""
NUDGE_BACK_M = 0.12
"""Distance that the base draws back from it."""
INSIDE_WAYS_M = (0.0, 0.1, 0.2, SHELF_DEPTH_M)
"""Distances that the base may drive straight in where it has just turned the object."""
_HOME_WEIGHT = 0.8
"""Weight of a control step on the way back to rest there: hardly any time is left."""


def pick(view: WorldView) -> Motion:
    """Pick up the active subtask's object and bring it home; try again while there is time."""
    subtask = view.subtask
    assert subtask is not None
    return (yield from pick_up(view, subtask.obj))


def pick_up(view: WorldView, obj: str, *, keep: bool = True) -> Motion:
    """Pick up an object, wherever it lies, and bring it home; try again while there is time.

    ``keep``: hold it there, and start again when it is lost; else end as soon as it is lifted.
    """
    failed = np.zeros((0, 3))
    attempt = 0
    short = False
    nudges = 0
    inside = False
    while True:
        found = _planned(view, obj, failed, attempt, inside)
        attempt += 1
        if found is None and nudges < MAX_NUDGES and view.steps_left > NUDGE_STEPS:
            nudges += 1
            if (yield from _nudge(view, obj)):
                inside = True
                continue
        if found is None:
            yield from motion.hold(
                view, WAIT_STEPS[min(attempt, len(WAIT_STEPS)) - 1], gripper=motion.OPEN
            )
            failed = failed[:0]
            continue
        stance, goals, depth = found
        taken = yield from _take(view, obj, stance, goals, depth, hasty=inside)
        short = taken is None and not depth and not short
        if short:
            # The base stopped a little too far off: from where it is another grasp is the quickest. Once: the plan
            # may be to stay, and would be the same for ever.
            continue
        if taken:
            if depth or inside:
                speed = (
                    HASTY_SPEED_M_S if inside or view.steps_left < LATE_OUT_STEPS else OUT_SPEED_M_S
                )
                yield from drive_out(view, SHELF_DEPTH_M, gripper=motion.CLOSED, speed=speed)
            if not keep and holds(view, obj):
                return True
            yield from go_home(view, obj)
            yield from _keep(view, obj)
        failed = np.concatenate([failed, stance.at[None, BASE]])
        yield from _draw_back(view, obj, stance, depth)


def _draw_back(view: WorldView, obj: str, stance: Stance, depth: float) -> Motion:
    """Get out of where a grasp was tried in vain, the base having come in over ``depth``, if it got so far."""
    # A hand that presses against something inside is not drawn back before the base is.
    if not (depth and view.link_forces.sum() > BLOCKED_FORCE_N):
        yield from _let_go(view)
    if (
        not depth
        or (come_in := depth - float(np.linalg.norm(view.base[:2] - stance.at[BASE_XY]))) < INSIDE_M
    ):
        return True
    # From inside the next way in can hardly be found.
    yield from drive_out(view, come_in, gripper=motion.OPEN)
    return (yield from go_home(view, obj, holding=False))


def _planned(
    view: WorldView, obj: str, failed: Array, attempt: int, inside: bool
) -> tuple[Stance, HandGoals, float] | None:
    """`plan_pick` with the wished kind of grasp, else with any; ``inside``: from where the object was just turned."""
    if inside and (found := _plan_inside(view, obj, failed)) is not None:
        return found
    wish = style_of(view).grasp
    for k in (0, 1, 2) if attempt == 0 else (attempt,):
        found = plan_pick(view, obj, failed, k, wish)
        if found is None and wish != ANY:
            found = plan_pick(view, obj, failed, k)
        # On a shelf waiting helps little, and an object that has to be turned needs the time.
        if found is not None or attempt or not inside_depth(view, view.object_pose(obj)[:3]):
            return found
    return None


def plan_pick(
    view: WorldView, obj: str, failed: Array, attempt: int = 0, wish: str = ANY
) -> tuple[Stance, HandGoals, float] | None:
    """The best way to grasp an object: stance, grasps it refers to, and how far the base comes straight in [m].

    Args:
        failed: (A, 3) base poses that did not work.
        attempt: number of attempts before; later ones take what the first leave out.
        wish: the kind of grasp, a word of `tasks.style.Style.grasp`.
    """
    pose = view.object_pose(obj)
    shape = view.object_shape(obj)
    scene = scene_of(view, obj)
    depth = inside_depth(view, pose[:3])
    around = scene.beside.near(pose[:3], 0.5)
    if depth:
        every = _shelf_grasps(shape, pose, scene, _inward(view, pose), around, _CLEAR[-1][0])
    else:
        every = grasp_candidates(
            LyingObject.of(shape, pose, scene.support_z),
            neighbours=around,
            gripper=view.robot.gripper,
            options=OPTIONS,
        )
    every = balanced(of_kind(every, wish), pose[:3])
    room = hand_room(view.robot.gripper, every, around) if depth else None
    best = None
    tried = 0
    blocked: list[Blocked] = []
    for asked, hand, nearer in _CLEAR[min(attempt, 1) :]:
        keep = every.clear >= asked
        grasps = every.take(np.flatnonzero(keep if room is None else keep & (room > hand)))
        if len(grasps) <= tried:
            continue
        tried = len(grasps)
        goals = _diverse(grasps)
        for back in _ways_in(depth, attempt):
            work = Work(
                point=pose[:3],
                goals=goals,
                scene=scene,
                drive_in=back,
                avoid=failed,
                room=CLEARANCES_M[min(attempt, 2)],
                nearer=nearer,
            )
            found = stances(view, work, blocked)
            if found and (best is None or found[0].route.room > best[0].route.room):
                best = found[0], goals, back
            if best is not None and (not depth or best[0].route.room >= 0.0):
                return roomier(view, best, blocked)
    return roomier(view, best, blocked)


def _shelf_grasps(
    shape: ObjectShape,
    pose: Array,
    scene: Scene,
    inward: tuple[float, float],
    around: Boxes,
    clear: float,
) -> Grasps:
    """Grasps of an object on a shelf at ``pose`` (7,), best first, with some room to the boxes ``around``."""
    hand = scene.body.gripper
    gripper = replace(hand, usable=hand.shelf_usable, blunt=SHELF_BLUNT_M)
    for options in (SHELF_OPTIONS, LOW_SHELF_OPTIONS):
        found = grasp_candidates(
            LyingObject.of(shape, pose, scene.support_z),
            neighbours=around,
            options=replace(options, inward=inward, least_clear_m=clear),
            gripper=gripper,
        )
        if len(found) or shape.kind != "bowl":
            break
    return found


def _plan_inside(
    view: WorldView, obj: str, failed: Array
) -> tuple[Stance, HandGoals, float] | None:
    """Like `plan_pick`, for an object on a shelf that was just turned: the quickest grasp counted to the way home."""
    pose = view.object_pose(obj)
    scene = scene_of(view, obj)
    around = scene.beside.near(pose[:3], 0.5)
    shape = view.object_shape(obj)
    every = balanced(
        _shelf_grasps(shape, pose, scene, _inward(view, pose), around, _CLEAR[-1][0]), pose[:3]
    )
    room = hand_room(view.robot.gripper, every, around)
    best = None
    least = np.inf
    for (asked, hand, nearer), arm in zip(_CLEAR, CLEARANCES_M, strict=True):
        rows = np.flatnonzero((every.clear >= asked) & (room > hand))
        if not len(rows):
            continue
        goals = _diverse(every.take(rows))
        for back in INSIDE_WAYS_M:
            work = Work(
                point=pose[:3],
                goals=goals,
                scene=scene,
                drive_in=back,
                avoid=failed,
                room=arm,
                nearer=nearer,
                home=_HOME_WEIGHT,
            )
            for stance in stances(view, work):
                cost = (
                    stance.route.steps
                    + in_steps(back)
                    + _HOME_WEIGHT * float(motion.steps_home(view.robot, stance.at))
                )
                cost += 1e4 * max(-stance.route.room, 0.0)
                if cost < least:
                    best = (stance, goals, back)
                    least = cost
        if best is not None and best[0].route.room >= 0.0:
            break
    return best


def _nudge(view: WorldView, obj: str) -> Motion:
    """Turn an object on a shelf such that it can be grasped, and draw back a little. Returns whether it turned."""
    pose = view.object_pose(obj)
    scene = scene_of(view, obj)
    if not inside_depth(view, pose[:3]):
        return False
    way = _inward(view, pose)
    place = min(
        (p for p in view.home.receptacles if p.kind == "shelf"),
        key=lambda p: float(np.linalg.norm(pose[:3] - p.pos)),
    )
    turns = np.round((np.arctan2(way[1], way[0]) - place.yaw) / (np.pi / 2))
    angle = place.yaw + turns * np.pi / 2
    inward = np.array([np.cos(angle), np.sin(angle)])
    shape = view.object_shape(obj)
    around = scene.beside.near(pose[:3], 0.5)

    def graspable(after: Array, more: float) -> int:
        straight = float(inward[0]), float(inward[1])
        every = _shelf_grasps(shape, after, scene, straight, around, _CLEAR[0][0] + more)
        return int((hand_room(view.robot.gripper, every, around) > _CLEAR[0][1] + 1.5 * more).sum())

    plan = plan_nudge(view, obj, scene, inward, graspable)
    if plan is None:
        return False
    done = yield from nudge(view, obj, plan, scene.all, graspable)
    yield from drive_out(view, NUDGE_BACK_M, gripper=motion.OPEN)
    return done


def balanced(grasps: Grasps, centre: Array) -> Grasps:
    """Grasps in the order of scores that count how far beside the pads the object's ``centre`` (3,) hangs."""
    aside = np.abs(np.einsum("gj,gj->g", centre - grasps.pos, grasps.rot[:, :, 2]))
    score = grasps.score - OFFSET_PRICE_PER_M * np.maximum(aside - FREE_OFFSET_M, 0.0)
    return replace(grasps, score=score).take(np.argsort(-score, kind="stable"))


def scene_of(view: WorldView, obj: str) -> Scene:
    """What is around an object that lies somewhere."""
    pose = view.object_pose(obj)
    shape = view.object_shape(obj)
    near, target = surroundings(view, obj, pose[:3])
    support = float(pose[2]) - height_below(shape, mat_from_quat(pose[3:]))
    return Scene(near, target, support, view.robot)


def _inward(view: WorldView, pose: Array) -> tuple[float, float]:
    """Level unit vector from the robot to an object at ``pose`` (7,)."""
    way = pose[:2] - view.base[:2]
    x, y = way / max(float(np.linalg.norm(way)), 1e-6)
    return float(x), float(y)


def _ways_in(depth: float, attempt: int) -> tuple[float, ...]:
    """How far to come in with the arm stretched out; a second attempt is quicker from where the base is."""
    if not depth:
        return (0.0,)
    return (0.0, depth) if attempt else (depth, 0.0)


def height_below(shape: ObjectShape, rot: Array) -> float:
    """How far [m] an object turned by ``rot`` (3, 3) reaches below its centre."""
    up = np.abs(rot[2])
    half = np.array(shape.half)
    if shape.kind in ("box", "mesh"):
        return float(up @ half)
    if shape.kind == "sphere":
        return float(half.max())
    return float(half[0] * np.hypot(up[0], up[1]) + half[2] * up[2])


def _diverse(grasps: Grasps) -> HandGoals:
    """The best grasps that differ from each other."""
    kept: list[int] = []
    for i in range(min(len(grasps), 600)):
        if len(kept) >= MAX_GOALS:
            break
        turn = np.einsum("gij,ij->g", grasps.rot[kept], grasps.rot[i])
        shift = np.linalg.norm(grasps.pos[kept] - grasps.pos[i], axis=1)
        if not kept or ((turn < 1.0 + 2.0 * np.cos(0.3)) | (shift > 0.025)).all():
            kept.append(i)
    g = grasps.take(np.array(kept))
    return HandGoals(g.pos, g.rot, g.pre, g.opening, g.score)


def _take(
    view: WorldView, obj: str, stance: Stance, goals: HandGoals, depth: float, hasty: bool = False
) -> Generator[Array, None, bool | None]:
    """Drive there, reach, close, lift. Returns whether the object is in the hand; None where it is out of reach."""
    start = view.object_pose(obj)[:3]
    goal = goals.take(np.array([stance.goal]))
    opening = grip(view.robot, float(goal.opening[0]) + 0.004)
    arrived = yield from follow(view, stance.route, gripper=opening)
    if not arrived and view.link_forces.sum() > BLOCKED_FORCE_N:
        yield from go_home(view, obj, holding=False)
        return False
    if depth:
        boxes = scene_of(view, obj).all
        hasty = hasty or view.steps_left < LATE_IN_STEPS
        if not (
            yield from drive_in(
                view,
                ReachIn(stance.pre, goal.pre[0], goal.rot[0]),
                boxes,
                gripper=opening,
                hasty=hasty,
            )
        ):
            return False
    if np.linalg.norm(view.object_pose(obj)[:3] - start) > 0.02:
        return False
    joints = settle_reach(view, stance, np.stack([goal.pre[0], goal.pos[0]]), goal.rot[0])
    if joints is None:
        return None
    if not (yield from _reach(view, goal, joints, opening)):
        return False
    pos = goal.pos[0]
    rot = goal.rot[0]
    fine = _is_fine(goal)
    # Fingers that close while the hand still moves twist the object and press sideways for seconds.
    if fine:
        # A finger that brushed along shoved the object: the pads must meet both of its sides at once all the same.
        pos = pos + view.object_pose(obj)[:3] - start
    until = wait_for(view, motion.is_quiet)
    steps = 6 if fine else 4
    yield from motion.still_tcp(view, pos, rot, gripper=opening, steps=steps, until=until)
    closed = yield from (
        motion.close_fingers(view, obj, steps=25, rate=FINE_CLOSING_M)
        if fine
        else motion.close_fingers(view, obj)
    )
    if not closed:
        return False
    up = pos + np.array([0.0, 0.0, SHELF_LIFT_M if depth else LIFT_M])
    return (yield from _lift(view, obj, up, rot, joints[1]))


def _is_fine(goal: HandGoals) -> bool:
    """Whether the fingers have little room on both sides of the object at a grasp (one row)."""
    return bool(goal.opening[0] > FINE_OPENING_M)


def _reach(view: WorldView, goal: HandGoals, joints: Array, opening: float) -> Motion:
    """Bring the open hand to a grasp (one row) by way of its ``pre``. Returns whether it got there.

    Args:
        joints: (2, J) configurations at ``pre`` and at the grasp.
        opening: gripper command.
    """
    yield from motion.move_joints(view, joints[0], gripper=opening, tolerance=0.04, max_steps=20)
    # The torso is slow to stop: the last piece belongs to the arm alone.
    straight = motion.HandMove(
        pos=goal.pre[0],
        rot=goal.rot[0],
        gripper=opening,
        rest=joints[1],
        speed=0.3,
        tolerance=0.006,
        max_steps=20,
        stop_on_force=80.0,
        torso=False,
    )
    if not (yield from motion.move_tcp(view, straight)):
        return False
    fine = _is_fine(goal)
    if fine:
        until = wait_for(view, motion.is_quiet)
        yield from motion.still_tcp(
            view, goal.pre[0], goal.rot[0], gripper=opening, steps=4, until=until
        )
    last = replace(straight, pos=goal.pos[0], speed=0.15 if fine else 0.2, max_steps=25)
    yield from motion.move_tcp(view, last)
    return bool(np.linalg.norm(motion.tcp(view)[0] - goal.pos[0]) <= MAX_SHORT_M)


def _lift(view: WorldView, obj: str, up: Array, rot: Array, rest: Array) -> Motion:
    """Lift what the hand holds to ``up`` (3,), ``rot`` (3, 3) kept; ``rest`` (J,): preferred posture."""
    if not (yield from motion.raise_tcp(view, up, rot, rest=rest)):
        # The arm is at its limit; the torso is slower.
        yield from motion.move_tcp(
            view,
            motion.HandMove(
                pos=up,
                rot=rot,
                gripper=motion.CLOSED,
                rest=rest,
                speed=0.15,
                tolerance=0.01,
                max_steps=15,
            ),
        )
    return bool((view.finger_forces(obj) > 0.3).all())


def _keep(view: WorldView, obj: str) -> Motion:
    """Hold the object at rest until it is lost."""
    lost = 0
    goal = motion.rest_goal(view)
    while lost < 4:
        yield motion.action(view, goal, gripper=motion.CLOSED)
        lost = lost + 1 if (view.finger_forces(obj) < 0.1).all() else 0
    return False


def _let_go(view: WorldView) -> Motion:
    """Open the hand and draw it back and up, unless it is home already."""
    if motion.joint_gap(view, motion.rest_goal(view)) < 0.1:
        return True
    pos, rot = motion.tcp(view)
    yield from motion.hold(view, 4, gripper=motion.OPEN)
    back = pos - 0.10 * rot[:, 0] + np.array([0.0, 0.0, 0.03])
    return (
        yield from motion.move_tcp(
            view,
            motion.HandMove(
                pos=back, rot=rot, gripper=motion.OPEN, speed=0.3, tolerance=0.02, max_steps=15
            ),
        )
    )
