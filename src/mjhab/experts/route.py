"""Moving base and arm at the same time: what the way will sweep is looked at before it is driven.

Lengths [m], angles [rad], world frame. Letters: T control steps, P way points, Q joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.envs.privileged import WorldView
from mjhab.experts import ik, motion
from mjhab.experts.clearance import Boxes, RobotSpheres
from mjhab.experts.kinematics import wrap
from mjhab.experts.motion import Motion
from mjhab.experts.navigation import CONTROL_DT, DriveLimits, Follower

Array = np.ndarray
LOOSE = DriveLimits(pos_tolerance=0.03, yaw_tolerance=0.05)
"""The hand makes up for the last centimetres of the base."""
MARGIN = 0.015
"""Room [m] wanted around the robot on its way."""
DRIVE_ERROR = 0.03
"""More room [m] wanted while the base drives."""
_DELAYS = (0.0, 0.3, 0.5, 0.7, 0.85, 1.0)
BASE_LAG = 0.15
"""Time constant [s] of the base's speed."""
BLOCKED_FORCE = 60.0
BLOCKED_STEPS = 4


@dataclass(frozen=True, eq=False)
class Route:
    """A drive along ``path`` (P, 2) to the heading ``yaw``, the arm going to ``arm`` (15,) from step ``delay`` on.

    ``steps``: how long it should take; ``room``: least clearance on the way beyond what was asked for [m].
    """

    path: Array
    yaw: float
    direction: int
    arm: Array
    delay: int
    steps: int
    room: float


def plan_route(
    view: WorldView, goal: Array, arm: Array, robot: RobotSpheres, boxes: Boxes, *, margin: float = MARGIN,
    direction: int = 0, straight: bool = False,
) -> Route | None:  # fmt: skip
    """The quickest way to the base pose ``goal`` (3,) with the arm at ``arm`` (15,) that keeps clear of ``boxes``.

    The arm starts at once if there is room, otherwise later; when even the whole way with the arm as it is comes too
    close, the route with the most room is given: look at its ``room``.

    Args:
        robot: what moves, the held object included.
        direction: see `motion.drive_to`.
        straight: do not plan around furniture.
    """
    start = view.q
    path = np.stack([start[:2], goal[:2]]) if straight else motion.planner(view.home).plan(start[:2], goal[:2])
    if path is None:
        return None
    if np.linalg.norm(path[-1] - goal[:2]) > 1e-6:
        path = np.concatenate([path, goal[None, :2]])
    poses, direction = _simulate(start[:3], path, float(goal[2]), direction)
    before = float(_room(start[None], robot, boxes)[0])
    best: Route | None = None
    for delay in sorted({round(share * len(poses)) for share in _DELAYS}):
        swept = _swept(start, poses, arm, delay)
        at = np.arange(0, len(swept), max(1, len(swept) // 24))
        # While the base drives, the robot is only about where it is expected to be.
        asked = np.minimum(np.where(at < len(poses) - 1, margin + DRIVE_ERROR, margin), before - 0.004)
        room = float((_room(swept[at], robot, boxes) - asked).min())
        route = Route(path, float(goal[2]), direction, arm, delay, len(swept), room)
        if room >= 0.0:
            return route
        if best is None or room > best.room:
            best = route
    return best


def follow(view: WorldView, route: Route, *, gripper: float, tolerance: float = 0.05) -> Motion:
    """Drive a route. Returns whether base and arm arrived; not when something is in the way."""
    follower = Follower(route.path, route.yaw, LOOSE, route.direction)
    start, pressed, arrived = view.q, 0, False
    moving = motion.drives(view, route.path[-1], route.yaw)
    for step in range(route.steps + 40):
        drive = follower.step(view.q[:3]) if moving and not arrived else None
        arrived = arrived or drive is None or drive.done
        on_time = step >= route.delay or arrived
        off = motion.joint_gap(view, route.arm)
        if arrived and off <= tolerance:
            return True
        speed = (0.0, 0.0) if drive is None or arrived else (drive.v, drive.w)
        ramp = min(1.0, 0.25 * (1 + step - min(step, route.delay)))
        yield motion.action(view, route.arm if on_time else start, gripper=gripper, drive=speed, speed=ramp)
        pressed = pressed + 1 if view.link_forces.sum() > BLOCKED_FORCE else 0
        if pressed >= BLOCKED_STEPS:
            return False
    return False


def _simulate(pose: Array, path: Array, yaw: float, direction: int) -> tuple[Array, int]:
    """Base poses (T, 3) that following a path should give, and the direction that was chosen."""
    follower = Follower(path, yaw, LOOSE, direction)
    pose, speed, turn = pose.copy(), 0.0, 0.0
    share = 1.0 - np.exp(-CONTROL_DT / BASE_LAG)
    poses = [pose.copy()]
    if np.linalg.norm(path[-1] - pose[:2]) > 0.01 or abs(wrap(yaw - pose[2])) > 0.03:
        for _ in range(140):
            drive = follower.step(pose)
            if drive.done:
                break
            speed += share * (drive.v - speed)
            turn += share * (drive.w - turn)
            pose = pose + CONTROL_DT * np.array([speed * np.cos(pose[2]), speed * np.sin(pose[2]), turn])
            poses.append(pose.copy())
    return np.array(poses), follower.direction


def _swept(start: Array, poses: Array, arm: Array, delay: int) -> Array:
    """Configurations (T, Q), one per control step, until base and arm have arrived."""
    way = arm - start
    way[:3] = 0.0
    limits = ik.step_limits(motion.chain())
    share = limits / np.maximum(np.abs(way), 1e-9)
    columns = list(motion.ARM_JOINTS)
    share[columns] = share[columns].min()
    needed = int(np.ceil(1.0 / max(float(share[3:13].min()), 1e-3)))
    steps = np.arange(max(len(poses), delay + needed) + 1)
    out = start + np.clip((steps - delay)[:, None] * share, 0.0, 1.0) * way
    out[:, :3] = poses[np.minimum(steps, len(poses) - 1)]
    return out


def _room(q: Array, robot: RobotSpheres, boxes: Boxes) -> Array:
    return np.minimum(robot.clearance(q, boxes), robot.self_clearance(q))
