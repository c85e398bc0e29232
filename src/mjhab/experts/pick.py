"""The expert that picks objects: from tables and seats, out of the opened drawer, from the shelf of the fridge."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

import numpy as np

from mjhab.core.rotations import mat_from_quat
from mjhab.envs.grasps import Grasps, Gripper, ObjectShape, Options, grasp_candidates
from mjhab.envs.held import shape_of
from mjhab.envs.privileged import WorldView
from mjhab.experts import motion
from mjhab.experts.carry import drive_in, drive_out, go_home, grip, inside_depth
from mjhab.experts.motion import Motion
from mjhab.experts.reach import ROOMS, HandGoals, Scene, Stance, hand_room, settle_reach, stances, surroundings
from mjhab.experts.route import BLOCKED_FORCE, follow, holds
from mjhab.experts.style import of_kind, style_of
from mjhab.tasks.style import ANY

Array = np.ndarray
LIFT = 0.10
"""How far [m] an object is lifted off an open surface before it is carried."""
SHELF_LIFT = 0.025
WAITS = (5, 10, 20, 50)
"""Control steps to wait after one attempt after the other without a way: things may come to rest meanwhile."""
MAX_GOALS = 60
EVEN, LEVER = 0.015, 15.0
"""How far [m] beside the pads the centre of an object may be at no price, and the price in points per metre beyond: its
weight turns such an object between the pads, and with less than a push on top it slips out."""
OPTIONS = Options(palm_gap=0.012, floor_gap=0.008)
# Little room: closer steps around the object, a short way in, and boxes nearly as wide as the hand opens.
SHELF_OPTIONS = replace(OPTIONS, fan=36, shallower=(0.0, 0.02), retreat=0.06)
SHELF_GRIPPER = Gripper(usable=0.0945)
_CLEAR = ((0.010, -0.008, 0.0), (0.0, -0.02, 0.010), (-0.004, -0.03, 0.014))
"""Room [m] asked between gripper and neighbours, on a shelf also with its wrist (the spheres that stand for it are up
to 8 mm too large), and how much nearer than the arm the hand may come; less each time no good way is found."""


def pick(view: WorldView) -> Motion:
    """Pick up the active subtask's object and bring it home; try again while there is time."""
    subtask = view.subtask
    assert subtask is not None
    return (yield from fetch(view, subtask.obj))


def fetch(view: WorldView, obj: str, *, keep: bool = True) -> Motion:
    """Pick up an object, wherever it lies, and bring it home; try again while there is time.

    ``keep``: hold it there, and start again when it is lost; else end as soon as it is lifted.
    """
    failed, attempt, short = np.zeros((0, 3)), 0, False
    while True:
        wish = style_of(view).grasp
        found = plan_pick(view, obj, failed, attempt, wish)
        if found is None and wish != ANY:
            found = plan_pick(view, obj, failed, attempt)
        attempt += 1
        if found is None:
            yield from motion.hold(view, WAITS[min(attempt, len(WAITS)) - 1], gripper=motion.OPEN)
            failed = failed[:0]
            continue
        stance, goals, depth = found
        taken = yield from _take(view, obj, stance, goals, depth)
        short = taken is None and not depth and not short
        if short:
            # The base stopped a little too far off: from where it is another grasp is the quickest. Once: the plan
            # may be to stay, and would be the same for ever.
            continue
        if taken:
            if depth:
                yield from drive_out(view, depth, gripper=motion.CLOSED)
            if not keep and holds(view, obj):
                return True
            yield from go_home(view, obj)
            yield from _keep(view, obj)
        failed = np.concatenate([failed, stance.at[None, :3]])
        yield from _let_go(view)
        if depth:
            # From inside the next way in can hardly be found.
            yield from drive_out(view, depth, gripper=motion.OPEN)
            yield from go_home(view, obj, holding=False)


def plan_pick(
    view: WorldView, obj: str, failed: Array, attempt: int = 0, wish: str = ANY
) -> tuple[Stance, HandGoals, float] | None:  # fmt: skip
    """The best way to grasp an object: stance, grasps it refers to, and how far the base comes straight in [m].

    Args:
        failed: (A, 3) base poses that did not work.
        attempt: number of attempts before; later ones take what the first leave out.
        wish: the kind of grasp, a word of `tasks.style.Style.grasp`.
    """
    pose, shape, scene = view.object_pose(obj), shape_of(view.object_type(obj)), scene_of(view, obj)
    depth = inside_depth(view, pose[:3])
    around = scene.beside.near(pose[:3], 0.5)
    options = replace(SHELF_OPTIONS, inward=_inward(view, pose)) if depth else OPTIONS
    every = grasp_candidates(
        shape, pose[:3], pose[3:], support_z=scene.support_z, neighbours=around, least_clear=_CLEAR[-1][0],
        options=options, gripper=SHELF_GRIPPER if depth else None,
    )  # fmt: skip
    every = balanced(of_kind(every, wish), pose[:3])
    room, best, tried = hand_room(every, around) if depth else None, None, 0
    for asked, hand, nearer in _CLEAR[min(attempt, 1) :]:
        keep = every.clear >= asked
        grasps = every.take(np.flatnonzero(keep if room is None else keep & (room > hand)))
        if len(grasps) <= tried:
            continue
        tried, goals = len(grasps), _diverse(grasps)
        for back in _ways_in(depth, attempt):
            found = stances(
                view, pose[:3], goals, scene, drive_in=back, avoid=failed, room=ROOMS[min(attempt, 2)], nearer=nearer
            )
            if found and (best is None or found[0].route.room > best[0].route.room):
                best = found[0], goals, back
            if best is not None and (not depth or best[0].route.room >= 0.0):
                return best
    return best


def balanced(grasps: Grasps, centre: Array) -> Grasps:
    """Grasps in the order of scores that count how far beside the pads the object's ``centre`` (3,) hangs."""
    aside = np.abs(np.einsum("gj,gj->g", centre - grasps.pos, grasps.rot[:, :, 2]))
    score = grasps.score - LEVER * np.maximum(aside - EVEN, 0.0)
    return replace(grasps, score=score).take(np.argsort(-score, kind="stable"))


def scene_of(view: WorldView, obj: str) -> Scene:
    """What is around an object that lies somewhere."""
    pose, shape = view.object_pose(obj), shape_of(view.object_type(obj))
    near, target = surroundings(view, obj, pose[:3])
    return Scene(near, target, float(pose[2]) - height_below(shape, mat_from_quat(pose[3:])))


def _inward(view: WorldView, pose: Array) -> tuple[float, float]:
    """Level unit vector from the robot to an object at ``pose`` (7,)."""
    way = pose[:2] - view.q[:2]
    x, y = way / max(float(np.linalg.norm(way)), 1e-6)
    return float(x), float(y)


def _ways_in(depth: float, attempt: int) -> tuple[float, ...]:
    """How far to come in with the arm stretched out; a second attempt is quicker from where the base is."""
    if not depth:
        return (0.0,)
    return (0.0, depth) if attempt else (depth, 0.0)


def height_below(shape: ObjectShape, rot: Array) -> float:
    """How far [m] an object turned by ``rot`` (3, 3) reaches below its centre."""
    up, half = np.abs(rot[2]), np.array(shape.half)
    if shape.kind == "box":
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
    view: WorldView, obj: str, stance: Stance, goals: HandGoals, depth: float
) -> Generator[Array, None, bool | None]:
    """Drive there, reach, close, lift. Returns whether the object is in the hand; None where it is out of reach."""
    start = view.object_pose(obj)[:3]
    pos, rot, pre = goals.pos[stance.goal], goals.rot[stance.goal], goals.pre[stance.goal]
    opening = grip(float(goals.opening[stance.goal]) + 0.004)
    arrived = yield from follow(view, stance.route, gripper=opening)
    if not arrived and view.link_forces.sum() > BLOCKED_FORCE:
        yield from go_home(view, obj, holding=False)
        return False
    if depth:
        boxes = scene_of(view, obj).all
        if not (yield from drive_in(view, stance.pre, pre, rot, boxes, gripper=opening)):
            return False
    if np.linalg.norm(view.object_pose(obj)[:3] - start) > 0.02:
        return False
    joints = settle_reach(view, stance, np.stack([pre, pos]), rot)
    if joints is None:
        return None
    yield from motion.move_joints(view, joints[0], gripper=opening, tolerance=0.04, max_steps=20)
    # The torso is slow to stop: the last piece belongs to the arm alone.
    near = yield from motion.move_tcp(
        view, pre, rot, gripper=opening, rest=joints[1], speed=0.3, tolerance=0.006, max_steps=20, stop_on_force=80.0,
        torso=False,
    )  # fmt: skip
    if not near:
        return False
    yield from motion.move_tcp(
        view, pos, rot, gripper=opening, rest=joints[1], speed=0.2, tolerance=0.006, max_steps=25, stop_on_force=80.0,
        torso=False,
    )  # fmt: skip
    # Fingers that close while the hand still moves twist the object and press sideways for seconds.
    yield from motion.still_tcp(view, pos, rot, gripper=opening, steps=4)
    if not (yield from motion.close_fingers(view, obj)):
        return False
    up = pos + np.array([0.0, 0.0, SHELF_LIFT if depth else LIFT])
    yield from motion.raise_tcp(view, up, rot, rest=joints[1])
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
    return (yield from motion.move_tcp(view, back, rot, gripper=motion.OPEN, speed=0.3, tolerance=0.02, max_steps=15))
