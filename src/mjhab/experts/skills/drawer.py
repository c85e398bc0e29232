"""Opening and closing a drawer: the arm holds its posture, the base drives."""

from __future__ import annotations

import numpy as np

from mjhab.core.joints import BASE_XY
from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import motion
from mjhab.experts.planning import approach, stances
from mjhab.experts.planning.stances import Stances
from mjhab.experts.style import style_of
from mjhab.robots.robot import Robot
from mjhab.tasks.style import GRASP

Array = np.ndarray
Motion = motion.Motion
PRE_GRASP_M = 0.11
"""Distance from which the open hand moves straight onto the handle."""
BACK_OFF_M = 0.08
"""Distance between handle and hand at which the arm folds."""
AROUND_BAR_M = 0.045
"""Free space beside the bar in the hand that closes around it: bars in a recess leave no more."""
CLOSED_SHARE = 0.01
"""Share of the range at which a link counts as closed."""
SPEED_M_S = 0.45
"""Speed at which the drawer moves."""
HELD_SPEED_M_S = 0.3
"""Speed at which a drawer is shut by its handle: a hand that is pressed deep onto the bar is caught in its recess."""
MAX_GRASPS = 2
"""How often the handle is grasped to close the drawer before the closed fingers push it."""


def open_drawer(view: WorldView, link: JointedLink) -> Motion:
    """Grasp the bar, back up with it, let go and return to rest; anew after a slip."""
    full = link.range[1]
    while view.steps_left > 30 and view.link_q(link.id) < 0.92 * full:
        if not (yield from _take_handle(view, link, full)):
            yield from approach.let_go(view, BACK_OFF_M)
            continue
        yield from _drive_link(view, link, 0.95 * full, -SPEED_M_S)
        yield from approach.let_go(view, BACK_OFF_M)
    return (yield from approach.fold(view))


def close_drawer(view: WorldView, link: JointedLink) -> Motion:
    """Push the handle with the closed fingers by driving forward; or hold it, where that is asked for and goes."""
    goal = 0.4 * CLOSED_SHARE * link.range[1]
    grasps = MAX_GRASPS if style_of(view).close == GRASP else 0
    while view.steps_left > 30 and view.link_q(link.id) > 0.8 * CLOSED_SHARE * link.range[1]:
        if grasps > 0:
            grasps -= 1
            if (yield from _take_handle(view, link, 0.0)):
                yield from _drive_link(view, link, goal, HELD_SPEED_M_S)
            # Opened wide, fingers in a recess would pull the drawer along.
            yield from approach.let_go(view, BACK_OFF_M, gripper=_around(view.robot, link))
            continue
        found = stances.cached(view.robot, link, "push", _push_stances)
        moved = found.shifted(view.link_q(link.id))
        goals, _ = stances.rank(view, stances.Frame.of(link), moved, found.q[:, :1, BASE_XY])
        best = approach.best_route(view, goals[:, 0])
        if best is None:
            return False
        yield from approach.go(view, best[1], motion.CLOSED)
        yield from _drive_link(view, link, goal, SPEED_M_S, press=6)
        yield from approach.retreat(view, BACK_OFF_M)
    return (yield from approach.fold(view))


def _take_handle(view: WorldView, link: JointedLink, goal: float) -> Motion:
    """Hold the bar from where the base can move with it until the drawer is open by ``goal`` [m]."""
    found = stances.cached(view.robot, link, "pull", _pull_stances)
    q = view.link_q(link.id)
    end = found.q[:, :1, BASE_XY] + np.array([goal, 0.0])
    goals, _ = stances.rank(view, stances.Frame.of(link), found.shifted(q), end)
    best = approach.best_route(view, goals[:, 0])
    if best is None:
        return False
    posture = goals[best[0]]
    gripper = _around(view.robot, link)
    yield from approach.go(view, best[1], gripper)
    _, turn = view.robot.chain.tip_pose(posture[1])
    rot = stances.hand(-link.handle_pose(q)[2], turn[0, :, 1])
    return (yield from approach.take(view, link, rot, posture[1], gripper=gripper))


def _around(robot: Robot, link: JointedLink) -> float:
    """Gripper action for a hand that goes around the bar."""
    return motion.gripper_at(robot, link.handle.thickness + AROUND_BAR_M)


def _drive_link(
    view: WorldView, link: JointedLink, goal: float, speed: float, press: int = 0
) -> Motion:
    """Drive with the arm held until the link's joint has reached ``goal``; False when it stays where it is.

    Args:
        speed: forward [m/s]; negative pulls.
        press: control steps to go on at the goal, so that the link does not bounce.
    """
    posture = view.q
    heading = float(view.base[2])
    way = -1.0 if speed > 0 else 1.0
    last = view.link_q(link.id)
    still = 0
    for _ in range(70):
        now = view.link_q(link.id)
        left = way * (goal - now)
        if left <= 0:
            press -= 1
        if press < 0 and left <= 0:
            return True
        moving = abs(now - last) > 0.001
        still = 0 if moving else still + 1
        if still > 12:
            return False
        last = now
        size = min(abs(speed), 0.06 + 3.0 * left)
        yield approach.creep(view, posture, heading, np.sign(speed) * size, motion.CLOSED)
    return False


def _square(handle: Array, near: Array, side: Array) -> Array:
    """Base poses (N, 3) that face the furniture squarely, ``near`` before a handle and ``side`` beside it."""
    x, y = np.meshgrid(handle[0] + near, handle[1] + side, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, np.pi)], axis=1)


def _pull_stances(robot: Robot, link: JointedLink) -> Stances:
    """Before the closed drawer: hand before the handle, then on it, fingers above and below the bar."""
    handle, _, out = link.handle_pose(0.0)
    base = _square(handle, np.arange(0.62, 0.96, 0.04), np.linspace(-0.24, 0.24, 9))
    pos = np.stack([handle + PRE_GRASP_M * out, handle])
    boxes = [link.boxes(0.0)] * 2
    sides = [stances.hand(-out, np.array([0.0, 0.0, up])) for up in (1.0, -1.0)]
    return Stances.join([_still(robot, base, pos, rot, boxes) for rot in sides])


def _push_stances(robot: Robot, link: JointedLink) -> Stances:
    """Before the handle of the closed drawer (for an open one everything moves along): the fist before the bar."""
    handle, _, out = link.handle_pose(0.0)
    base = _square(handle, np.arange(0.58, 0.92, 0.04), np.linspace(-0.24, 0.24, 9))
    pos = np.stack([handle + 0.09 * out, handle + 0.04 * out])
    return _still(
        robot,
        base,
        pos,
        stances.hand(-out, np.array([0.0, 0.0, 1.0])),
        [link.boxes(0.0)] * 2,
        mode="approach",
    )


def _still(
    robot: Robot, base: Array, pos: Array, rot: Array, boxes: list, mode: motion.ik.Mode = "pose"
) -> Stances:
    n = len(base)
    k = len(pos)
    return stances.track(
        robot,
        np.repeat(base[:, None], k, axis=1),
        np.broadcast_to(pos, (n, k, 3)),
        np.broadcast_to(rot, (n, k, 3, 3)),
        boxes,
        mode=mode,
    )
