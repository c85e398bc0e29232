"""Scripts that open and close a drawer: the base drives with the arm held, or base and arm move together.

Lengths [m], angles [rad]. Letters: N configurations, J joints.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.joints import BASE, BASE_XY
from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.base.route import follow
from mjhab.experts.phases import phase
from mjhab.experts.planning import approach, link_motions, link_path
from mjhab.experts.planning.link_motions import HandPaths, LinkMotions
from mjhab.experts.planning.link_path import LinkPath
from mjhab.experts.skills import leaving
from mjhab.experts.style import style_of
from mjhab.robots.robot import Robot
from mjhab.tasks.style import ARM, GRASP

Motion = motion.Motion
PRE_GRASP_M = 0.11
"""Distance from which the open hand moves straight onto the handle."""
BACK_OFF_M = 0.08
"""Distance between handle and hand at which the arm retracts."""
AROUND_BAR_M = 0.045
"""Distance between the open fingers beyond the thickness of the bar; bars in a recess leave no more."""
CLOSED_SHARE = 0.01
"""Share of the range at which a link counts as closed. Success requires it."""
SPEED_M_S = 0.45
"""Speed at which the drawer moves."""
HELD_SPEED_M_S = 0.3
"""Speed at which a drawer is closed by its handle; faster, the hand gets stuck in the recess of the bar."""
OPEN_TO_SHARE = 0.95
"""Share of the range to which a drawer is pulled; 0.9 counts as open."""
ARM_DISTANCES_M = (0.4, 0.36)
"""Candidates for the part of the motion that the arm does with the style ``pull=arm``; the base does the rest."""
OPEN_ENOUGH_SHARE = 0.92
"""Share of the range from which on a drawer counts as open for the script."""
PULL_POINTS = 5
"""Way points from the closed to the open drawer."""
PULL_STEP_M = 0.018
"""Motion of the drawer per control step that the arm can follow."""
PULL_LEAD_M = 0.05
"""Largest distance of the hand's goal ahead of the drawer."""
RETRACT_POINTS = 16
"""Configurations of the motion back to rest at which its clearance is checked."""
RETRACT_CLEARANCE_M = 0.02
"""Least clearance of the arm during that motion."""
PULL_STEPS = 60
"""Control steps after which a pull is given up and the handle grasped again."""
MAX_GRASPS = 2
"""Attempts to close the drawer by its handle before the closed fingers push it."""


@phase("open the drawer", "pull")
def open_drawer(view: WorldView, link: JointedLink) -> Motion:
    """Open a drawer: grasp the bar, pull it, release it, return to rest; again after a slip."""
    full = link.range[1]
    pulls = style_of(view).pull == ARM
    # More than success asks for: the arm may still touch the drawer on its way back.
    enough = OPEN_ENOUGH_SHARE * full
    # Open fingers could catch the handle: after a pull by the arm the hand is close, and one touch throws a free drawer
    # shut.
    gripper = motion.CLOSED if pulls or view.links_run_free else motion.OPEN
    while view.steps_left > 30:
        if view.link_q(link.id) >= enough:
            if (yield from leaving.retract_beside(view, link, enough, gripper)):
                return True
            yield from leaving.settle(view, link, motion.CLOSED)
            continue
        # A style is a wish: where the arm finds no way, the base pulls.
        if pulls and (path := _arm_path(view, link)) is not None:
            if (yield from _take_on(view, link, path)):
                yield from _pull(view, link, path)
            yield from approach.let_go(view, BACK_OFF_M)
            continue
        if not (yield from _take_handle(view, link, full)):
            yield from approach.let_go(view, BACK_OFF_M)
            continue
        yield from _drive_link(view, link, OPEN_TO_SHARE * full, -SPEED_M_S)
        yield from approach.let_go(view, BACK_OFF_M)
    return (yield from approach.retract(view, gripper=gripper))


@phase("close the drawer", "approach")
def close_drawer(view: WorldView, link: JointedLink) -> Motion:
    """Close a drawer: push its handle with the closed fingers by driving forward.

    With the style ``close=grasp`` the hand holds the handle instead, in up to `MAX_GRASPS` attempts.
    """
    # Further than success requires, because the drawer may bounce open again.
    goal = 0.4 * CLOSED_SHARE * link.range[1]
    grasps = MAX_GRASPS if style_of(view).close == GRASP else 0
    while (
        view.steps_left > 30 and view.link_q(link.id) > 0.8 * CLOSED_SHARE * link.range[1]
    ):
        if grasps > 0:
            grasps -= 1
            if (yield from _take_handle(view, link, 0.0)):
                yield from _push_shut(view, link, goal, HELD_SPEED_M_S)
            # Wide open fingers would be stuck in a recess and pull the drawer along.
            yield from approach.let_go(
                view, BACK_OFF_M, gripper=_around(view.robot, link)
            )
            continue
        found = link_motions.cached(view.robot, link, "push", _push_motions)
        # A drawer moves in a straight line: motions for the closed one hold for any opening, moved along.
        moved = found.shifted(view.link_q(link.id))
        goals, _ = link_motions.rank(
            view, link_motions.Frame.of(link), moved, found.q[:, :1, BASE_XY]
        )
        best = approach.best_route(view, goals[:, 0])
        if best is None:
            return False
        yield from follow(view, best[1], gripper=motion.CLOSED)
        yield from _push_shut(view, link, goal, SPEED_M_S, press=6)
        yield from approach.retreat(view, BACK_OFF_M)
    return (yield from approach.retract(view))


@phase("push the drawer shut", "push")
def _push_shut(
    view: WorldView, link: JointedLink, goal: float, speed: float, press: int = 0
) -> Motion:
    """Drive forward until the joint has reached ``goal`` [m], see `_drive_link`."""
    return (yield from _drive_link(view, link, goal, speed, press))


@phase("take the handle", "approach")
def _take_handle(view: WorldView, link: JointedLink, goal: float) -> Motion:
    """Grasp the bar from a motion from which the base can drive until the drawer is open by ``goal`` [m]."""
    found = link_motions.cached(view.robot, link, "pull", _pull_motions)
    q = view.link_q(link.id)
    # The base must have room where it stands in the end, not only where it grasps.
    end = found.q[:, :1, BASE_XY] + np.array([goal, 0.0])
    goals, _ = link_motions.rank(view, link_motions.Frame.of(link), found.shifted(q), end)
    best = approach.best_route(view, goals[:, 0])
    if best is None:
        return False
    posture = goals[best[0]]
    gripper = _around(view.robot, link)
    yield from follow(view, best[1], gripper=gripper)
    _, turn = view.robot.chain.tip_pose(posture[1])
    # The hand was planned either way up: the direction between its fingers tells which.
    rot = link_motions.hand(-link.handle_pose(q)[2], turn[0, :, 1])
    return (yield from approach.take(view, link, rot, posture[1], gripper=gripper))


def _arm_path(view: WorldView, link: JointedLink) -> LinkPath | None:
    """Plan the motion in which the arm pulls the drawer from its present opening; None if none is collision-free."""
    found = link_motions.cached(view.robot, link, "pull by arm", _arm_motions)
    q = view.link_q(link.id)
    goals, _ = link_motions.rank(view, link_motions.Frame.of(link), found.shifted(q))
    best = approach.best_route(view, goals[:, 0])
    if best is None:
        return None
    return LinkPath(view.robot, goals[best[0]], _arm_values(link) + q, best[1])


def _take_on(view: WorldView, link: JointedLink, path: LinkPath) -> Motion:
    """Move to the beginning of a path and grasp the handle. Returns whether the hand holds it."""
    gripper = _around(view.robot, link)
    yield from follow(view, path.route, gripper=gripper)
    q = view.link_q(link.id)
    rot = path.hand_at(q)[1]
    return (yield from approach.take(view, link, rot, path.at(q), gripper=gripper))


@phase("pull the drawer by the arm", "pull")
def _pull(view: WorldView, link: JointedLink, path: LinkPath) -> Motion:
    """Move hand and base along the path until the drawer is open. Returns False when the hand loses the handle."""
    goal = OPEN_TO_SHARE * link.range[1]
    aim = view.link_q(link.id)
    for _ in range(PULL_STEPS):
        now = view.link_q(link.id)
        if now >= goal:
            return True
        if not view.finger_forces(link.id).any() and aim > now + PULL_LEAD_M:
            return False
        # The goal waits for a drawer that lags, but never moves back: that would push.
        aim = min(aim + PULL_STEP_M, max(aim, now + PULL_LEAD_M), float(path.values[-1]))
        yield link_path.action(view, path, aim, PULL_STEP_M, motion.CLOSED)
    return False


def _around(robot: Robot, link: JointedLink) -> float:
    """Gripper command with which the open fingers fit around the bar."""
    return motion.gripper_at(robot, link.handle.thickness + AROUND_BAR_M)


@phase("move the drawer by the base")
def _drive_link(
    view: WorldView, link: JointedLink, goal: float, speed: float, press: int = 0
) -> Motion:
    """Drive straight with the arm held until the link's joint has reached ``goal``.

    Args:
        view: the world.
        link: the drawer.
        goal: joint value [m].
        speed: forward speed of the base [m/s]; negative pulls.
        press: control steps for which the base drives on at the goal, so that the link does not bounce.

    Returns:
        Whether the joint has reached ``goal``; False when it stops before.
    """
    posture = view.q
    heading = float(view.base[2])
    sign = -1.0 if speed > 0 else 1.0
    last = view.link_q(link.id)
    still = 0
    for _ in range(70):
        now = view.link_q(link.id)
        left = sign * (goal - now)
        # It is pressed for some steps: the drawer may bounce open again.
        if left <= 0:
            press -= 1
        if press < 0 and left <= 0:
            return True
        moving = abs(now - last) > 0.001
        still = 0 if moving else still + 1
        if still > 12:
            return False
        last = now
        # Slower towards the end, where the drawer would bounce.
        size = min(abs(speed), 0.06 + 3.0 * left)
        yield approach.creep(view, posture, heading, np.sign(speed) * size, motion.CLOSED)
    return False


def _square(handle: np.ndarray, near: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Base poses (N, 3) that face the furniture squarely: all combinations of ``near`` (X,) and ``side`` (Y,) offsets
    from the position (3,) of a handle."""
    x, y = np.meshgrid(handle[0] + near, handle[1] + side, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, np.pi)], axis=1)


def _pull_motions(robot: Robot, link: JointedLink) -> LinkMotions:
    """Find motions at the closed drawer: hand in front of the handle, then on it, fingers above and below the bar."""
    handle, _, out = link.handle_pose(0.0)
    base = _square(handle, np.arange(0.62, 0.96, 0.04), np.linspace(-0.24, 0.24, 9))
    pos = np.stack([handle + PRE_GRASP_M * out, handle])
    boxes = [link.boxes(0.0)] * 2
    sides = [link_motions.hand(-out, np.array([0.0, 0.0, up])) for up in (1.0, -1.0)]
    return LinkMotions.join([_still(robot, base, pos, rot, boxes) for rot in sides])


def _arm_values(link: JointedLink) -> np.ndarray:
    """Joint values (1 + PULL_POINTS,) [m] of the way points of `_arm_motions`; at first the hand is before the bar."""
    return np.append(
        -PRE_GRASP_M,
        np.linspace(0.0, (OPEN_TO_SHARE + 0.05) * link.range[1], PULL_POINTS),
    )


def _arm_motions(robot: Robot, link: JointedLink) -> LinkMotions:
    """Find motions as `_pull_motions`, followed by the pull, in which arm and base move together."""
    out = link.handle_pose(0.0)[2]
    values = _arm_values(link)
    handles = [link.handle_pose(max(float(value), 0.0))[0] for value in values]
    pos = np.stack([handles[0] + PRE_GRASP_M * out, *handles[1:]])
    boxes = [link.boxes(max(float(value), 0.0)) for value in values]
    # Wide to both sides: a nearby motion needs less turning on the way, and turns are hard to imitate.
    base = _square(handles[0], np.arange(0.78, 1.03, 0.04), np.linspace(-0.54, 0.54, 19))
    opened = np.clip(values, 0.0, None)
    found = []
    for sign in ARM_DISTANCES_M:
        driven = opened * (1.0 - sign / opened[-1])
        paths = np.repeat(base[:, None], len(values), axis=1)
        paths[:, :, 0] += driven
        for up in (1.0, -1.0):
            rot = link_motions.hand(-out, np.array([0.0, 0.0, up]))
            found.append(
                link_motions.track(
                    robot,
                    HandPaths(
                        paths,
                        np.broadcast_to(pos, (len(paths), *pos.shape)),
                        np.broadcast_to(rot, (len(paths), len(values), 3, 3)),
                    ),
                    boxes,
                )
            )
    every = LinkMotions.join(found)
    keep = _retracts(robot, every.q[:, -1], link.boxes(float(opened[-1])))
    return LinkMotions(every.q[keep], every.steps[keep], every.back[keep])


def _retracts(robot: Robot, end: np.ndarray, boxes: Boxes) -> np.ndarray:
    """(N,) bool: the arm can retract to rest without a collision after the base has backed up by `BACK_OFF_M`.

    Args:
        robot: the robot.
        end: (N, J) configurations at the end of the pull.
        boxes: collision boxes of the open drawer.
    """
    start = end.copy()
    # The script backs off by this before the arm retracts, so this is where clearance counts.
    start[:, 0] += BACK_OFF_M
    rest = ik.unwind(robot.chain, robot.rest, start)
    rest[:, BASE] = start[:, BASE]
    share = np.linspace(0.0, 1.0, RETRACT_POINTS)[:, None]
    paths = start[:, None] + share * (rest - start)[:, None]
    gaps = motion.spheres(robot).clearance(paths.reshape(-1, paths.shape[-1]), boxes)
    return gaps.reshape(len(end), RETRACT_POINTS).min(axis=1) > RETRACT_CLEARANCE_M


def _push_motions(robot: Robot, link: JointedLink) -> LinkMotions:
    """Find motions at the closed drawer with the closed fingers in front of the bar; an open drawer shifts them."""
    handle, _, out = link.handle_pose(0.0)
    base = _square(handle, np.arange(0.58, 0.92, 0.04), np.linspace(-0.24, 0.24, 9))
    pos = np.stack([handle + 0.09 * out, handle + 0.04 * out])
    return _still(
        robot,
        base,
        pos,
        link_motions.hand(-out, np.array([0.0, 0.0, 1.0])),
        [link.boxes(0.0)] * 2,
        # Closed fingers push with their tips: the turn about their axis does not matter.
        mode="approach",
    )


def _still(
    robot: Robot,
    base: np.ndarray,
    pos: np.ndarray,
    rot: np.ndarray,
    boxes: list,
    mode: motion.ik.Mode = "pose",
) -> LinkMotions:
    """Find motions with unmoved base poses (N, 3) for K hand positions ``pos`` (K, 3) at one rotation (3, 3).

    ``boxes``: K obstacles, one `Boxes` per hand position.
    """
    n = len(base)
    k = len(pos)
    paths = HandPaths(
        np.repeat(base[:, None], k, axis=1),
        np.broadcast_to(pos, (n, k, 3)),
        np.broadcast_to(rot, (n, k, 3, 3)),
        mode,
    )
    return link_motions.track(robot, paths, boxes)
