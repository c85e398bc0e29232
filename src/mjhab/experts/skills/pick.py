"""The expert for Pick: from tables and seats, from an open drawer, from a shelf of the fridge.

Lengths [m], angles [rad], world frame. Letters: A base poses that did not work, J joints.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

import numpy as np

from mjhab.core.joints import BASE, BASE_XY
from mjhab.core.rotations import mat_from_quat
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import motion
from mjhab.experts.arm.held import holds
from mjhab.experts.arm.motion import Motion
from mjhab.experts.base.route import BLOCKED_FORCE_N, follow
from mjhab.experts.phases import phase
from mjhab.experts.planning.carry import (
    FAST_SPEED_M_S,
    OUT_SPEED_M_S,
    SHELF_DEPTH_M,
    ReachIn,
    drive_in,
    drive_out,
    go_home,
    go_home_fast,
    inside_depth,
    shelf_heading,
)
from mjhab.experts.planning.reach import hand_clearance, settle_reach
from mjhab.experts.planning.workplace import (
    BasePlacement,
    HandGoals,
)
from mjhab.experts.skills.nudge import nudge
from mjhab.experts.skills.nudge_plans import plan_nudge
from mjhab.experts.skills.pick_plans import (
    GRASP_CLEARANCES_M,
    plan_inside,
    plan_pick,
    scene_of,
    shelf_grasps,
)
from mjhab.experts.style import follows_rule, style_of, wait_for
from mjhab.tasks.style import ANY

INSIDE_M = 0.06
"""Distance driven into a shelf above which the base drives out again before another attempt."""
LIFT_M = 0.10
"""Height by which an object is lifted off an open surface before it is carried."""
SHELF_LIFT_M = 0.025
"""The same on a shelf."""
LIFT_STEPS = 16
"""Control steps after which a lift by the arm alone is given up."""
FAST_LIFT_STEPS = 7
"""The same on a shelf when few control steps are left."""
LATE_IN_STEPS = 130
"""With fewer control steps left, the base drives into a shelf at `FAST_SPEED_M_S`."""
LATE_OUT_STEPS = 60
"""With fewer control steps left, the base drives out of a shelf at `FAST_SPEED_M_S`."""
FINE_OPENING_M = 0.094
"""Opening of the hand above which less than 3 mm of free space are left on either side of the object. The hand opens
0.0985 m."""
FINE_CLOSING_M = 0.004
"""Motion of the fingers per control step while they close on a can beside its axis: an impact would push it out. With
it, and pads that come in exactly, 23 of 24 master chef cans were picked, before 9 of 20."""
MIN_ALONG_COSINE = 0.995
"""Cosine between the line on which the fingers close and an axis of a box above which they close along the axis. 6
degrees."""
MAX_SHORT_M = 0.025
"""Largest distance of the hand from its grasp at which the fingers close."""
HELD_N = 0.3
"""Force on each finger above which the object counts as held."""
HOME_RAD = 0.1
"""`motion.joint_gap` to the rest configuration below which the arm counts as home."""
WAIT_STEPS = (5, 10, 20, 50)
"""Control steps to wait after the first, second, ... attempt without a plan: objects may come to rest meanwhile."""
MAX_NUDGES = 2
"""Largest number of pushes that turn an object."""
NUDGE_STEPS = 115
"""Control steps that must be left to turn an object."""
NUDGE_BACK_M = 0.12
"""Distance that the base drives backwards after a push."""


def pick(view: WorldView) -> Motion:
    """Pick up the object of the active subtask and bring the arm to rest; repeated until the episode ends."""
    subtask = view.subtask
    assert subtask is not None
    return (yield from pick_up(view, subtask.obj))


@phase("pick up", "approach")
def pick_up(view: WorldView, obj: str, *, keep: bool = True) -> Motion:
    """Pick up an object wherever it lies and bring the arm to rest; repeated until the episode ends.

    An object that is in the hand already, because another policy acted before, is carried on.

    Args:
        view: world to act in.
        obj: name of the object.
        keep: hold the object at rest, and start again when it is lost; False: end as soon as it is lifted.
    """
    if _is_held(view, obj) and (yield from _carry_on(view, obj, keep)):
        return True
    failed = np.zeros((0, 3))
    attempt = 0
    short = False
    nudges = 0
    inside = False
    while True:
        found = _planned(view, obj, failed, attempt, inside)
        attempt += 1
        # A push takes most of a subtask's time, so that it is the last thing to try.
        if found is None and nudges < MAX_NUDGES and view.steps_left > NUDGE_STEPS:
            nudges += 1
            if (yield from _nudge(view, obj)):
                inside = True
                continue
        if found is None:
            yield from motion.hold(
                view, WAIT_STEPS[min(attempt, len(WAIT_STEPS)) - 1], gripper=motion.OPEN
            )
            # Nothing else is left to try: the base poses that failed get another chance.
            failed = failed[:0]
            continue
        placement, goals, depth = found
        # By the rule always on a shelf: how much time is left cannot be observed.
        fast = inside or (bool(depth) and follows_rule(view))
        taken = yield from _take(view, obj, placement, goals, depth, fast=fast)
        # Noted for one attempt only, see below.
        short = taken is None and not short
        if short:
            # The base stopped a little too far away, or the object moved: another grasp from the present base pose is
            # the quickest. Only once, because a plan that keeps the base where it is would be repeated for ever.
            inside = inside or bool(depth)
            continue
        if taken:
            shelf = bool(depth) or inside
            if (yield from _carry(view, obj, shelf=shelf, fast=fast, keep=keep)):
                return True
        # The same base pose would fail again for the same reason.
        failed = np.concatenate([failed, placement.at[None, BASE]])
        yield from _draw_back(view, obj, placement, depth)


def _is_held(view: WorldView, obj: str) -> bool:
    """Whether both fingers press an object."""
    return bool((view.finger_forces(obj) > HELD_N).all())


def _carry_on(view: WorldView, obj: str, keep: bool) -> Motion:
    """Lift and carry an object that another policy has grasped, see `_carry`."""
    shelf = bool(inside_depth(view, view.object_pose(obj)[:3]))
    if motion.joint_gap(view, motion.rest_goal(view)) > HOME_RAD:
        pos, rot = motion.tcp(view)
        up = pos + np.array([0.0, 0.0, SHELF_LIFT_M if shelf else LIFT_M])
        yield from _lift(view, obj, up, rot, view.q, shelf)
    return (yield from _carry(view, obj, shelf=shelf, fast=False, keep=keep))


@phase("carry", "carry")
def _carry(view: WorldView, obj: str, *, shelf: bool, fast: bool, keep: bool) -> Motion:
    """Bring a lifted object out of a ``shelf`` and the arm to rest, and hold it there until it is lost.

    Returns whether the object is out and still held where it need not be kept (``keep``, see `pick_up`); else False.
    """
    # Out of the shelf by the arm alone is faster; a Place that picks up again has to drive anyway.
    if shelf and not (keep and (yield from go_home_fast(view, obj))):
        speed = (
            FAST_SPEED_M_S if fast or view.steps_left < LATE_OUT_STEPS else OUT_SPEED_M_S
        )
        yield from drive_out(view, SHELF_DEPTH_M, gripper=motion.CLOSED, speed=speed)
    if not keep and holds(view, obj):
        return True
    yield from go_home(view, obj)
    # The subtask ends by itself once the robot has been at rest with the object.
    yield from _keep(view, obj)
    return False


@phase("leave the failed grasp", "retract")
def _draw_back(
    view: WorldView, obj: str, placement: BasePlacement, depth: float
) -> Motion:
    """Leave the place of a failed grasp, to which the base drove straight in over up to ``depth`` [m]."""
    # A hand that presses against furniture is not moved before the base has driven out.
    if not (depth and view.link_forces.sum() > BLOCKED_FORCE_N):
        yield from _let_go(view)
    if (
        not depth
        or (
            come_in := depth
            - float(np.linalg.norm(view.base[:2] - placement.at[BASE_XY]))
        )
        < INSIDE_M
    ):
        return True
    # From inside the next way in can hardly be found.
    yield from drive_out(view, come_in, gripper=motion.OPEN)
    return (yield from go_home(view, obj, holding=False))


def _planned(
    view: WorldView, obj: str, failed: np.ndarray, attempt: int, inside: bool
) -> tuple[BasePlacement, HandGoals, float] | None:
    """`plan_pick` with the kind of grasp of the style, else with any.

    ``inside``: the object was just turned by a push, and the base still stands before the shelf.
    """
    if inside and (found := plan_inside(view, obj, failed)) is not None:
        return found
    wish = style_of(view).grasp
    for k in (0, 1, 2) if attempt == 0 else (attempt,):
        found = plan_pick(view, obj, failed, k, wish)
        if found is None and wish != ANY:
            found = plan_pick(view, obj, failed, k)
        # On a shelf waiting helps little, and an object that has to be turned needs the time.
        if (
            found is not None
            or attempt
            or not inside_depth(view, view.object_pose(obj)[:3])
        ):
            return found
    return None


@phase("look for a push", "approach")
def _nudge(view: WorldView, obj: str) -> Motion:
    """Turn an object on a shelf such that it can be grasped, and draw back a little. Returns whether it turned."""
    pose = view.object_pose(obj)
    scene = scene_of(view, obj)
    if not inside_depth(view, pose[:3]):
        return False
    inward = motion.ahead(shelf_heading(view, pose[:3]))
    shape = view.object_shape(obj)
    # What is farther away cannot meet the hand or the box as it turns.
    around = scene.beside.near(pose[:3], 0.5)

    def graspable(after: np.ndarray, more: float) -> int:
        straight = float(inward[0]), float(inward[1])
        every = shelf_grasps(
            shape, after, scene, straight, around, GRASP_CLEARANCES_M[0][0] + more
        )
        return int(
            (
                hand_clearance(view.robot.gripper, every, around)
                > GRASP_CLEARANCES_M[0][1] + 1.5 * more
            ).sum()
        )

    plan = plan_nudge(view, obj, scene, inward, graspable)
    if plan is None:
        return False
    done = yield from nudge(view, obj, plan, scene.all, graspable)
    yield from drive_out(view, NUDGE_BACK_M, gripper=motion.OPEN)
    return done


@phase("take the object", "approach")
def _take(
    view: WorldView,
    obj: str,
    placement: BasePlacement,
    goals: HandGoals,
    depth: float,
    fast: bool = False,
) -> Generator[np.ndarray, None, bool | None]:
    """Drive there, reach, close, lift. Returns whether the object is in the hand; None where it is out of reach or,
    on a shelf, was shifted on the way."""
    start = view.object_pose(obj)[:3]
    goal = goals.take(np.array([placement.goal]))
    opening = motion.gripper_at(view.robot, float(goal.opening[0]) + 0.004)
    arrived = yield from follow(view, placement.route, gripper=opening)
    if not arrived and view.link_forces.sum() > BLOCKED_FORCE_N:
        yield from go_home(view, obj, holding=False)
        return False
    if depth:
        boxes = scene_of(view, obj).all
        fast = fast or view.steps_left < LATE_IN_STEPS
        if not (
            yield from drive_in(
                view,
                ReachIn(placement.pre, goal.pre[0], goal.rot[0]),
                boxes,
                gripper=opening,
                fast=fast,
            )
        ):
            return False
    # A grasp is planned for the pose before: beyond this the fingers would close beside it.
    if np.linalg.norm(view.object_pose(obj)[:3] - start) > 0.02:
        return None if depth else False
    joints = settle_reach(
        view, placement, np.stack([goal.pre[0], goal.pos[0]]), goal.rot[0]
    )
    if joints is None:
        return None
    # Boxes leave enough room between the fingers: where little time is left they are taken quickly.
    fine = _is_fine(goal)
    quick = fast and view.object_shape(obj).kind == "box"
    if not (yield from _reach(view, goal, joints, opening, fine and not quick)):
        return False
    fine = fine and not (quick and _is_along(view, obj, goal))
    pos = goal.pos[0]
    rot = goal.rot[0]
    # Fingers that close while the hand still moves twist the object and press sideways for seconds.
    if fine:
        # A finger that brushed along shoved the object: the pads must meet both of its sides at once all the same.
        pos = pos + view.object_pose(obj)[:3] - start
    until = wait_for(view, motion.is_quiet)
    steps = 6 if fine and not quick else 4
    yield from motion.still_tcp(view, pos, rot, gripper=opening, steps=steps, until=until)
    closed = yield from (
        motion.close_fingers(view, obj, steps=25, rate=FINE_CLOSING_M)
        if fine
        else motion.close_fingers(view, obj)
    )
    if not closed:
        return False
    up = pos + np.array([0.0, 0.0, SHELF_LIFT_M if depth or fast else LIFT_M])
    return (yield from _lift(view, obj, up, rot, joints[1], quick))


def _is_fine(goal: HandGoals) -> bool:
    """Whether the fingers have little room on both sides of the object at a grasp (one row)."""
    return bool(goal.opening[0] > FINE_OPENING_M)


def _is_along(view: WorldView, obj: str, goal: HandGoals) -> bool:
    """Whether the fingers close along an axis of the object at a grasp (one row)."""
    axes = mat_from_quat(view.object_pose(obj)[3:])
    return bool(np.abs(goal.rot[0, :, 1] @ axes).max() > MIN_ALONG_COSINE)


@phase("reach for the object", "approach")
def _reach(
    view: WorldView, goal: HandGoals, joints: np.ndarray, opening: float, fine: bool
) -> Motion:
    """Bring the open hand to a grasp (one row) by way of its ``pre``. Returns whether it got there.

    Args:
        joints: (2, J) configurations at ``pre`` and at the grasp.
        opening: gripper command.
        fine: move slowly at the end.
    """
    yield from motion.move_joints(
        view, joints[0], gripper=opening, tolerance=0.04, max_steps=20
    )
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
    if fine:
        until = wait_for(view, motion.is_quiet)
        yield from motion.still_tcp(
            view, goal.pre[0], goal.rot[0], gripper=opening, steps=4, until=until
        )
    # The last piece is slow, as the object is between the fingers already.
    last = replace(straight, pos=goal.pos[0], speed=0.15 if fine else 0.2, max_steps=25)
    yield from motion.move_tcp(view, last)
    return bool(np.linalg.norm(motion.tcp(view)[0] - goal.pos[0]) <= MAX_SHORT_M)


@phase("lift", "lift")
def _lift(
    view: WorldView,
    obj: str,
    up: np.ndarray,
    rot: np.ndarray,
    rest: np.ndarray,
    fast: bool,
) -> Motion:
    """Lift what the hand holds to ``up`` (3,), ``rot`` (3, 3) kept; ``rest`` (J,): preferred posture.

    ``fast``: on a shelf, a lift that the arm cannot do in a few steps is left out.
    """
    steps = FAST_LIFT_STEPS if fast else LIFT_STEPS
    if (
        not (yield from motion.raise_tcp(view, up, rot, rest=rest, max_steps=steps))
        and not fast
    ):
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
    return _is_held(view, obj)


@phase("hold the object at rest", "hold")
def _keep(view: WorldView, obj: str) -> Motion:
    """Hold the object at rest until it is lost."""
    lost = 0
    goal = motion.rest_goal(view)
    # Forces vanish for single steps while the arm moves; only a lasting loss counts.
    while lost < 4:
        yield motion.action(view, goal, gripper=motion.CLOSED)
        lost = lost + 1 if (view.finger_forces(obj) < 0.1).all() else 0
    return False


@phase("draw the hand back", "retract")
def _let_go(view: WorldView) -> Motion:
    """Open the hand and draw it back and up, unless it is home already."""
    if motion.joint_gap(view, motion.rest_goal(view)) < HOME_RAD:
        return True
    pos, rot = motion.tcp(view)
    yield from motion.hold(view, 4, gripper=motion.OPEN)
    # Up a little as well, because a hand that drags over the surface takes the object along.
    back = pos - 0.10 * rot[:, 0] + np.array([0.0, 0.0, 0.03])
    return (
        yield from motion.move_tcp(
            view,
            motion.HandMove(
                pos=back,
                rot=rot,
                gripper=motion.OPEN,
                speed=0.3,
                tolerance=0.02,
                max_steps=15,
            ),
        )
    )
