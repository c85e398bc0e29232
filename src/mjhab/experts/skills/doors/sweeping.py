"""Closing a door with the base: straight drives with the arm at rest that push it shut from its outside.

Lengths [m], angles [rad]. Letters: N drives, K poses of the base, C circles.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import functools

import numpy as np

from mjhab.core.joints import BASE
from mjhab.core.rotations import wrap
from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import motion
from mjhab.experts.base.route import follow
from mjhab.experts.phases import phase
from mjhab.experts.planning import link_motions
from mjhab.experts.planning.link_motions import LinkMotions
from mjhab.experts.skills.doors.arc import (
    AJAR_SHARE,
    AT_REST_RAD,
    COAST_SPARE_RAD,
    PRESS_STEPS,
    coasts,
    reachable,
)
from mjhab.experts.skills.doors.motions import hand_side, panel
from mjhab.experts.style import style_of
from mjhab.robots.robot import Robot

Motion = motion.Motion
SWEEP_STEP_M = 0.05
"""Distance between two poses of the base at which a sweep is checked."""
SWEEP_SPEED_M_S = 0.7
"""Speed of the base while it sweeps a door shut with the arm at rest."""
SWEEP_CLEAR_RAD = 0.08
"""Angle between the door and the robot at the beginning of a sweep."""
SWEEP_TURN_RAD = 0.3
"""Largest turn of the door per `SWEEP_STEP_M`; larger ones mean that the arm meets the edge or the inside."""
SWEEP_OUTSIDE_M = 0.04
"""Least distance from the outside of the door at which a part of the robot comes past its edge."""
SWEEP_END_RAD = -0.03
"""Door angle at which a sweep ends: a little beyond the closed door, so that the arm presses it."""
SWEEP_POINTS = 6
"""Way points of a sweep."""
SWEEP_STEPS = 100
"""Greatest number of control steps of a sweep."""
SWEPT_M = 0.02
"""Distance from the end of a sweep at which the base has arrived."""


@phase("sweep the door shut with the base", "push")
def sweep(view: WorldView, link: JointedLink) -> Motion:
    """Drive to the outside of an open door and push it shut with the arm at rest, in a straight line.

    Returns whether the door is shut.
    """
    # Motions are cached per angle: rounding up limits the number of searches.
    angle = float(np.ceil(10.0 * view.link_q(link.id))) / 10.0
    search = functools.partial(sweeps, angle=angle)
    found = link_motions.cached(view.robot, link, f"sweep {angle:.1f}", search)
    path = reachable(view, link, found, np.linspace(1.0, 0.0, SWEEP_POINTS))
    if path is None:
        return False
    yield from follow(view, path.route, gripper=motion.OPEN)
    end = path.q[-1]
    last = view.link_q(link.id)
    still = 0
    for _ in range(SWEEP_STEPS):
        now = view.link_q(link.id)
        # A slowed script sees longer control steps, so that the same motion is slower in its time.
        speed = style_of(view).speed * (last - now) / STEP_SECONDS
        still = still + 1 if abs(now - last) < AT_REST_RAD else 0
        last = now
        left = end[:2] - view.base[:2]
        ahead = float(left @ motion.ahead(end[2]))
        shut = now < AJAR_SHARE * link.range[1]
        # A door that has just shut may bounce open, and one that stands still may only wait for the robot.
        if still > PRESS_STEPS and (shut or ahead < SWEPT_M):
            break
        drive = 0.0
        if not shut and coasts(speed) < now + COAST_SPARE_RAD:
            drive = min(SWEEP_SPEED_M_S, 0.2 + 0.35 * now, 3.0 * max(ahead, 0.0))
        # Close to the end the direction to it depends on the last millimetres.
        aim = np.arctan2(left[1], left[0]) if ahead > 0.4 else end[2]
        turn = float(np.clip(3.0 * wrap(aim - view.base[2]), -0.6, 0.6))
        yield motion.action(
            view, motion.rest_goal(view), gripper=motion.OPEN, drive=(drive, turn)
        )
    return view.link_q(link.id) < AJAR_SHARE * link.range[1]


def sweeps(robot: Robot, link: JointedLink, angle: float) -> LinkMotions:
    """Find straight drives with the arm at rest that push a door shut from its outside.

    The door is a plane that turns around its hinge, the robot a set of circles seen from above: those of its spheres
    that are as high as the door. The door angle along a drive is the largest one at which no circle cuts the plane.

    Args:
        robot: the robot.
        link: the door.
        angle: present angle of the door [rad].

    Returns:
        Motions with `SWEEP_POINTS` way points.
    """
    low, high = panel(link)
    m = hand_side(link)
    # What passes above or below the door does not push it.
    centers, radius = _resting_circles(robot, float(low[2]), float(high[2]))
    base = _drives(m)
    c = np.cos(base[..., 2, None])
    s = np.sin(base[..., 2, None])
    x = base[..., 0, None] + c * centers[:, 0] - s * centers[:, 1]
    # Mirrored doors are computed as doors of the other side, so that one formula serves both.
    y = m * (base[..., 1, None] + s * centers[:, 0] + c * centers[:, 1])
    gap = radius + high[0]
    far = np.hypot(x, y)
    bearing = np.arctan2(y, x)
    meets = far**2 - gap**2 < (float(np.abs([low[1], high[1]]).max()) + radius) ** 2
    # A circle nearer to the hinge than its radius has no tangent: 1 stands for a door that touches it at its bearing.
    widest = bearing + np.arccos(np.minimum(gap / np.maximum(far, 1e-9), 1.0))
    widest = np.where(meets, widest, np.inf).min(axis=2)
    # Positions before the last one that is clear of the door do not matter: the sweep begins there.
    first = _last_clear(widest > angle + SWEEP_CLEAR_RAD)
    row = np.arange(base.shape[1])
    door = np.where(row <= first[:, None], angle, np.minimum(widest, angle))
    # A door that nothing pulls stays where it was pushed to, although the robot moves on.
    door = np.minimum.accumulate(door, axis=1)
    before = np.c_[np.full(len(door), angle), door[:, :-1]]
    outside = far * np.cos(before[..., None] - bearing) - high[0]
    enters = meets.copy()
    enters[:, 1:] &= ~meets[:, :-1]
    wrong = (enters & (outside < SWEEP_OUTSIDE_M)).any(axis=2) | (
        before - door > SWEEP_TURN_RAD
    )
    shut = door <= SWEEP_END_RAD
    last = shut.argmax(axis=1)
    wrong &= (row > first[:, None]) & (row <= last[:, None])
    fits = (first >= 0) & shut.any(axis=1) & ~wrong.any(axis=1)
    found = [
        np.linspace(base[i, first[i]], base[i, last[i]], SWEEP_POINTS)
        for i in np.flatnonzero(fits)
    ]
    q = np.repeat(robot.rest[None, None], SWEEP_POINTS, axis=1)
    q = np.repeat(q, len(found), axis=0)
    q[..., BASE] = np.array(found).reshape(len(found), SWEEP_POINTS, 3)
    length = np.linalg.norm(q[:, -1, :2] - q[:, 0, :2], axis=1)
    return LinkMotions(q, np.zeros(len(q)), length / SWEEP_SPEED_M_S / STEP_SECONDS)


def _drives(m: float) -> np.ndarray:
    """Poses (N, K, 3) of the base on straight drives towards the outside of an open door; ``m``: `hand_side`."""
    headings = np.pi + m * np.arange(0.5, 1.71, 0.1)
    asides = np.arange(-0.8, 0.81, 0.05)
    along = np.arange(-1.8, 0.4, SWEEP_STEP_M)
    yaw, aside = (part.ravel()[:, None] for part in np.meshgrid(headings, asides))
    x = np.cos(yaw) * along - np.sin(yaw) * aside
    y = np.sin(yaw) * along + np.cos(yaw) * aside
    return np.stack([0.4 + x, y, np.broadcast_to(yaw, x.shape)], axis=2)


def _last_clear(clear: np.ndarray) -> np.ndarray:
    """Index (N,) of the last position before the first one of (N, K) that is not clear; -1 for none."""
    return np.where(clear.all(axis=1), -1, (~clear).argmax(axis=1) - 1)


def _resting_circles(
    robot: Robot, low: float, high: float
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (C, 2) in the frame of the base and radii (C,) of the resting robot's spheres between two heights [m]."""
    whole = motion.spheres(robot)
    rest = robot.rest.copy()
    rest[BASE] = 0.0
    centers = whole.centers(whole.chain.forward(rest[None]))[0]
    # Spheres that only graze the height count as well: to miss a contact is worse than to expect one.
    there = (centers[:, 2] + whole.radius > low) & (centers[:, 2] - whole.radius < high)
    return centers[there, :2], whole.radius[there]
