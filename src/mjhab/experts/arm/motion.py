"""Motions of one robot as scripts: generators that yield one action per control step.

A script reads its world through a `WorldView` before each action, so every motion is closed-loop. Scripts compose with
``yield from``; each motion gives up after a bounded number of steps and says in its return value whether it arrived.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mjhab.core.joints import BASE, BASE_XY
from mjhab.core.rotations import mat_from_quat
from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import HomeShapes, WorldView
from mjhab.experts.arm import ik
from mjhab.experts.arm.clearance import RobotSpheres
from mjhab.experts.base.navigation import FloorClearance, Follower, Planner
from mjhab.robots.robot import Robot

Array = np.ndarray
Motion = Generator[Array, None, bool]
Until = Callable[[WorldView], bool]
"""Tells whether a wait is over."""
OPEN = 1.0
CLOSED = -1.0
"""Gripper commands."""
QUIET_RAD_S = 0.3
"""Speed of the arm's joints below which what it reached for no longer shakes."""
OPENED_M = 0.004
"""Distance of a finger from where it was told to go at which the hand counts as opened."""
ARM_STEP_SHARE = 1.0 - np.exp(-0.5)
"""Share of a commanded change that an arm joint covers in one control step (kp/kd = 10 per second, 50 ms)."""


@lru_cache(maxsize=8)
def spheres(robot: Robot) -> RobotSpheres:
    """The links of a robot covered by spheres, for clearances."""
    geoms = robot.body.collision
    links = tuple(name for name in geoms if name not in (robot.base_link, robot.tcp))
    return RobotSpheres.from_geoms(
        robot.chain_with(links),
        geoms,
        skip=(robot.base_link,),
        trunk=robot.trunk_links,
        distal=robot.distal_links,
    )


@lru_cache(maxsize=8)
def arm_spheres(robot: Robot) -> RobotSpheres:
    """`spheres` without the trunk, which hardly reaches farther than the base: the map keeps both clear, and knows the
    shapes of furniture better than boxes around it do."""
    whole = spheres(robot)
    return whole.only([name for name in whole.chain.links if name not in robot.trunk_links])


def planner(home: HomeShapes) -> Planner:
    """Path planner of a home, made once."""
    return home.derived.get("planner", lambda: _planner(home))


def _planner(home: HomeShapes) -> Planner:
    # There is little time: a base that knows its way needs no wide berth.
    return Planner(
        FloorClearance(home.map_origin, home.map_cell, home.map_clearance),
        radius=home.robot.footprint.wide,
        comfort=0.12,
        caution=2.0,
        narrow=home.robot.footprint.narrow,
    )


def tcp(view: WorldView) -> tuple[Array, Array]:
    """Tool centre position (3,) and rotation (3, 3) in the world."""
    pose = view.tcp_pose
    return pose[:3], mat_from_quat(pose[3:])


def action(
    view: WorldView,
    goal: Array | None = None,
    *,
    gripper: float,
    drive: tuple[float, float] = (0.0, 0.0),
    speed: float = 1.0,
) -> Array:
    """The action that moves arm, head and torso towards the configuration ``goal`` (J,) and the base as told.

    ``drive``: forward speed [m/s], yaw rate [rad/s]. ``speed`` 0..1 bounds the joints; they arrive together.
    """
    robot = view.robot
    columns = robot.action
    limits = robot.limits
    out = np.zeros(columns.dim, np.float32)
    out[columns.gripper] = gripper
    out[columns.base_forward] = drive[0] / limits.forward
    out[columns.base_yaw] = drive[1] / limits.yaw_rate
    if goal is not None:
        wish = (goal - view.q) / limits.joint_delta
        arm = wish[list(robot.arm_columns)]
        out[columns.arm] = arm * min(1.0, speed / max(float(np.abs(arm).max()), 1e-9))
        out[columns.body] = np.clip(wish[list(robot.body_columns)], -1.0, 1.0)
    return out


def gripper_at(robot: Robot, opening: float) -> float:
    """The gripper command that opens the fingers to a width [m]."""
    low, high = robot.limits.gripper
    return float(np.clip((opening - low - high) / (high - low), CLOSED, OPEN))


def never(view: WorldView) -> bool:
    """A wait that ends after its number of control steps."""
    return False


def is_quiet(view: WorldView) -> bool:
    """Whether no joint of the arm is faster than `QUIET_RAD_S`."""
    return bool(np.abs(view.qd[list(view.robot.arm_columns)]).max() < QUIET_RAD_S)


def has_opened(command: float) -> Until:
    """Whether the fingers are about where the gripper ``command`` brings them."""

    def opened(view: WorldView) -> bool:
        finger = float(view.q[view.robot.columns.fingers].mean())
        return gripper_at(view.robot, 2.0 * (finger + OPENED_M)) >= command

    return opened


def hold(
    view: WorldView,
    steps: int,
    *,
    gripper: float,
    goal: Array | None = None,
    until: Until = never,
) -> Motion:
    """Stand still for some steps, keeping the configuration ``goal`` (J,) (default: the present one).

    ``until``: ends it earlier.
    """
    goal = view.q if goal is None else goal
    for _ in range(steps):
        if until(view):
            return True
        yield action(view, goal, gripper=gripper)
    return True


def move_joints(
    view: WorldView,
    goal: Array,
    *,
    gripper: float,
    tolerance: float = 0.03,
    max_steps: int = 80,
    speed: float = 1.0,
) -> Motion:
    """Bring arm, head and torso to ``goal`` (J,) in joint space; the base stands."""
    columns = _arm_and_torso(view.robot)
    for _ in range(max_steps):
        if np.abs(goal - view.q)[columns].max() <= tolerance:
            return True
        yield action(view, goal, gripper=gripper, speed=speed)
    return False


def drive_to(view: WorldView, goal: Array, *, gripper: float, max_steps: int = 120) -> Motion:
    """Drive the base to ``goal`` (3,) x, y [m], yaw [rad] around furniture, the arm held as it is."""
    path = planner(view.home).plan(view.base[:2], goal[BASE_XY])
    if path is None:
        return False
    if np.linalg.norm(path[-1] - goal[:2]) > 1e-6:
        path = np.concatenate([path, goal[None, :2]])
    follower = Follower(path, float(goal[2]))
    posture = view.q
    for _ in range(max_steps):
        step = follower.step(view.base)
        yield action(view, posture, gripper=gripper, drive=(step.v, step.w))
        if step.done:
            return True
    return False


@dataclass(frozen=True, eq=False, kw_only=True)
class HandMove:
    """A straight motion of the tool centre, by differential inverse kinematics over arm and torso.

    Attributes:
        pos, rot: goal (3,) [m], (3, 3) in the world.
        gripper: command, from CLOSED to OPEN.
        speed, turn: along the way [m/s], [rad/s].
        tolerance, angle_tolerance: how near [m], [rad] to the goal it ends.
        max_steps: control steps after which it gives up.
        rest: (J,) posture preferred in the null space, None for the present one.
        drive: forward speed [m/s] and yaw rate [rad/s] of the base meanwhile; the arm makes up for it.
        torso: whether the torso may move.
        stop_on_force: give up when the contact force on the arm exceeds this [N].
    """

    pos: Array
    rot: Array
    gripper: float
    speed: float = 0.25
    turn: float = 1.0
    tolerance: float = 0.008
    angle_tolerance: float = 0.1
    max_steps: int = 80
    rest: Array | None = None
    drive: tuple[float, float] = (0.0, 0.0)
    torso: bool = True
    stop_on_force: float = np.inf


def move_tcp(view: WorldView, move: HandMove) -> Motion:
    """Move the tool centre on a straight line to a pose. Returns whether it arrived."""
    robot = view.robot.chain
    rest = view.q if move.rest is None else move.rest
    dofs = ik.columns(robot, torso=move.torso)
    now, now_rot = tcp(view)
    carrot = now[None]
    carrot_rot = now_rot[None]
    for _ in range(move.max_steps):
        here, here_rot = tcp(view)
        off = np.linalg.norm(move.pos - here)
        if off <= move.tolerance and angle_between(here_rot, move.rot) <= move.angle_tolerance:
            return True
        if view.link_forces.sum() > move.stop_on_force:
            return False
        # The aim moves at the wanted speed but stays within reach of where the hand really is.
        carrot, carrot_rot = ik.straight_line(
            carrot,
            move.pos[None],
            carrot_rot,
            move.rot[None],
            move.speed * STEP_SECONDS,
            move.turn * STEP_SECONDS,
        )
        lead = carrot[0] - here
        size = np.linalg.norm(lead)
        aim = here + lead * min(1.0, 0.06 / max(size, 1e-9))
        base_next = view.base[None] + base_motion(view.base[2], move.drive)
        delta = ik.servo(
            robot, view.q, aim[None], carrot_rot, dofs, rest=rest, base_next=base_next
        )[0]
        yield action(view, view.q + delta / ARM_STEP_SHARE, gripper=move.gripper, drive=move.drive)
    return False


def still_tcp(
    view: WorldView, pos: Array, rot: Array, *, gripper: float, steps: int, until: Until = never
) -> Motion:
    """Keep the tool centre at a pose (3,), (3, 3) near the present one, until nothing moves any more.

    ``until``: ends it earlier.
    """
    robot = view.robot.chain
    dofs = ik.columns(robot, torso=False)
    for _ in range(steps):
        if until(view):
            return True
        delta = ik.servo(robot, view.q, pos[None], rot[None], dofs, rest=view.q)[0]
        yield action(view, view.q + delta / ARM_STEP_SHARE, gripper=gripper)
    return True


def raise_tcp(
    view: WorldView, pos: Array, rot: Array, *, rest: Array, max_steps: int = 16
) -> Motion:
    """Bring what the closed hand holds to a pose nearby; gently at first, a jerk would shift it between the pads."""
    near = min(0.02, 0.3 * float(np.linalg.norm(pos - tcp(view)[0])))
    for speed, steps in ((0.05, 1), (0.1, 1), (0.15, 1), (0.25, max_steps)):
        move = HandMove(
            pos=pos,
            rot=rot,
            gripper=CLOSED,
            rest=rest,
            speed=speed,
            tolerance=near,
            max_steps=steps,
            torso=False,
        )
        there = yield from move_tcp(view, move)
        if there:
            return True
    return False


def base_speeds(view: WorldView) -> tuple[float, float]:
    """Forward speed [m/s] and yaw rate [rad/s] of the base."""
    v_x, v_y, turn = view.qd[BASE]
    yaw = float(view.base[2])
    return float(np.cos(yaw) * v_x + np.sin(yaw) * v_y), float(turn)


def base_motion(yaw: float, drive: tuple[float, float]) -> Array:
    step = drive[0] * STEP_SECONDS
    return np.array([[step * np.cos(yaw), step * np.sin(yaw), drive[1] * STEP_SECONDS]])


def angle_between(now: Array, goal: Array) -> float:
    """Angle [rad] between two rotations (3, 3)."""
    return float(np.arccos(np.clip((np.trace(now.T @ goal) - 1) / 2, -1.0, 1.0)))


def close_fingers(
    view: WorldView, target: str, *, steps: int = 12, settle: int = 3, rate: float = math.inf
) -> Motion:
    """Close the gripper until both fingers press ``target`` for ``settle`` steps. Returns whether they do.

    Args:
        rate: how far [m] the commanded position of the fingers moves per control step until both press, then three
            times as far; without it they close with full force at once, and meet the target at 0.3 m/s.
    """
    goal = view.q
    pressed = 0
    command = float(view.q[view.robot.columns.fingers].mean())
    for _ in range(steps):
        command -= 3.0 * rate if pressed else rate
        yield action(view, goal, gripper=gripper_at(view.robot, 2.0 * command))
        pressed = pressed + 1 if (view.finger_forces(target) > 1.0).all() else 0
        if pressed >= settle and command <= view.robot.limits.gripper[0]:
            return True
    return False


def to_rest(view: WorldView, *, gripper: float, max_steps: int = 120) -> Motion:
    """Bring arm, torso and head to the rest pose."""
    return (
        yield from move_joints(
            view, rest_goal(view), gripper=gripper, tolerance=0.02, max_steps=max_steps
        )
    )


def rest_goal(view: WorldView) -> Array:
    """The rest configuration (J,) next to the present one: continuous joints take the short way."""
    q = view.q
    goal = view.robot.rest.copy()
    goal[BASE] = q[BASE]
    return ik.unwind(view.robot.chain, goal, q)


def steps_home(robot: Robot, q: Array) -> Array:
    """Control steps (...,) that the arm needs from configurations (..., J) to rest."""
    rest = ik.unwind(robot.chain, robot.rest, q)
    return ik.travel_steps(robot.chain, q, rest, ik.columns(robot.chain))


def stay_at_rest(view: WorldView, *, gripper: float) -> Motion:
    """Hold the rest pose until the subtask is over."""
    goal = rest_goal(view)
    while True:
        yield action(view, goal, gripper=gripper)


def joint_gap(view: WorldView, goal: Array) -> float:
    """Largest distance of the arm from ``goal`` (J,) [rad]; 1 cm of the torso counts as 0.03 rad."""
    off = np.abs(goal - view.q)
    arm = float(off[list(view.robot.arm_columns)].max())
    return max(arm, 3.0 * float(off[list(view.robot.torso_columns)].max(initial=0.0)))


def _arm_and_torso(robot: Robot) -> list[int]:
    return [*robot.arm_columns, *robot.torso_columns]


def drives(view: WorldView, xy: Array, yaw: float) -> bool:
    """Whether the base has to move to stand at ``xy`` (2,) with heading ``yaw``."""
    turn = (yaw - view.base[2] + np.pi) % (2 * np.pi) - np.pi
    return bool(np.linalg.norm(xy - view.base[:2]) > 0.015 or abs(turn) > 0.03)
