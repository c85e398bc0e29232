"""Motions of one robot as generators that yield one action (A,) per control step.

A motion reads the state of its world through a `WorldView` before each action, so that it is closed-loop. Motions
compose with ``yield from``. Each ends after a bounded number of control steps, except `stay_at_rest`, and returns
whether it reached its goal.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mjhab.core.joints import BASE
from mjhab.core.rotations import mat_from_quat
from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import ik
from mjhab.experts.arm.clearance import RobotSpheres
from mjhab.experts.phases import phase
from mjhab.robots.robot import Robot

Motion = Generator[np.ndarray, None, bool]
Until = Callable[[WorldView], bool]
"""Condition that ends a wait."""
OPEN = 1.0
CLOSED = -1.0
"""Gripper commands."""
QUIET_RAD_S = 0.3
"""Speed of every arm joint below which the arm counts as settled."""
OPENED_M = 0.004
"""Distance of a finger from its commanded position at which the hand counts as opened."""
ARM_STEP_SHARE = 1.0 - np.exp(-0.5)
"""Share of a commanded change that an arm joint covers in one control step (kp/kd = 10 per second, 50 ms)."""


@lru_cache(maxsize=8)
def spheres(robot: Robot) -> RobotSpheres:
    """Spheres that cover all links of a robot but its base, for clearances."""
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
    """`spheres` without the trunk links.

    The trunk extends hardly beyond the base, and the map of free floor keeps both clear. The map is also more accurate
    than the boxes around furniture.
    """
    whole = spheres(robot)
    return whole.only(
        [name for name in whole.chain.links if name not in robot.trunk_links]
    )


def tcp(view: WorldView) -> tuple[np.ndarray, np.ndarray]:
    """Tool centre position (3,) and rotation (3, 3) in the world."""
    pose = view.tcp_pose
    return pose[:3], mat_from_quat(pose[3:])


def action(
    view: WorldView,
    goal: np.ndarray | None = None,
    *,
    gripper: float,
    drive: tuple[float, float] = (0.0, 0.0),
    speed: float = 1.0,
) -> np.ndarray:
    """Compute the action (A,) float32 that moves arm, head and torso towards a configuration while the base drives.

    Args:
        view: the world.
        goal: (J,) configuration; None leaves arm, head and torso commands at 0.
        gripper: gripper command, from `CLOSED` to `OPEN`.
        drive: forward speed [m/s] and yaw rate [rad/s] of the base.
        speed: largest command of an arm joint, 0..1. All arm commands are scaled by the same factor, so that the arm
            moves straight in joint space.
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
        # Scaled as a whole: clipped by joint, the hand would leave the straight line in joint space.
        out[columns.arm] = arm * min(1.0, speed / max(float(np.abs(arm).max()), 1e-9))
        # Apart from the arm, which need not wait for the slow torso.
        out[columns.body] = np.clip(wish[list(robot.body_columns)], -1.0, 1.0)
    return out


def hand_action(
    view: WorldView,
    goals: ik.TipGoals,
    *,
    gripper: float,
    drive: tuple[float, float] = (0.0, 0.0),
    rest_gain: float = 0.02,
) -> np.ndarray:
    """Compute the action (A,) that moves the tcp to a pose nearby while the base drives; the arm compensates the drive.

    Args:
        view: the world.
        goals: one pose of the tcp, what may move, and the posture preferred in the null space.
        gripper: gripper command, from `CLOSED` to `OPEN`.
        drive: forward speed [m/s] and yaw rate [rad/s] of the base.
        rest_gain: see `ik.servo`.
    """
    base_next = view.base[None] + base_motion(view.base[2], drive)
    delta = ik.servo(
        view.robot.chain, view.q, goals, base_next=base_next, rest_gain=rest_gain
    )[0]
    # A servo covers only this share of a change in one control step.
    return action(view, view.q + delta / ARM_STEP_SHARE, gripper=gripper, drive=drive)


def gripper_at(robot: Robot, opening: float) -> float:
    """Gripper command for a distance ``opening`` [m] between the fingers, clipped to the range of the gripper."""
    return float(np.clip(robot.limits.gripper_entry(opening), CLOSED, OPEN))


def gripper_at_rest(robot: Robot) -> float:
    """Gripper command for the opening of the rest posture, with which subtasks begin after a reset or a teleport."""
    return gripper_at(robot, float(robot.rest[list(robot.finger_columns)].sum()))


def never(view: WorldView) -> bool:
    """Condition of a wait that only ends after its number of control steps."""
    return False


def is_quiet(view: WorldView) -> bool:
    """Whether no joint of the arm is faster than `QUIET_RAD_S`."""
    return bool(np.abs(view.qd[list(view.robot.arm_columns)]).max() < QUIET_RAD_S)


def has_opened(command: float) -> Until:
    """Make the condition that the fingers are within `OPENED_M` of where the gripper ``command`` opens them to."""

    def opened(view: WorldView) -> bool:
        finger = float(view.q[view.robot.columns.fingers].mean())
        return gripper_at(view.robot, 2.0 * (finger + OPENED_M)) >= command

    return opened


def hold(
    view: WorldView,
    steps: int,
    *,
    gripper: float,
    goal: np.ndarray | None = None,
    until: Until = never,
) -> Motion:
    """Stand still in a configuration.

    Args:
        view: the world.
        steps: control steps.
        gripper: gripper command.
        goal: (J,) configuration; the present one if not given.
        until: condition that ends the wait earlier.
    """
    goal = view.q if goal is None else goal
    for _ in range(steps):
        if until(view):
            return True
        yield action(view, goal, gripper=gripper)
    return True


def move_joints(
    view: WorldView,
    goal: np.ndarray,
    *,
    gripper: float,
    tolerance: float = 0.03,
    max_steps: int = 80,
    speed: float = 1.0,
) -> Motion:
    """Move arm, head and torso straight in joint space while the base stands.

    Args:
        view: the world.
        goal: (J,) configuration.
        gripper: gripper command.
        tolerance: largest distance of an arm joint [rad] and the torso [m] from the goal at which the motion ends.
        max_steps: control steps after which the motion gives up.
        speed: see `action`.

    Returns:
        Whether arm and torso arrived.
    """
    columns = _arm_and_torso(view.robot)
    for _ in range(max_steps):
        if np.abs(goal - view.q)[columns].max() <= tolerance:
            return True
        yield action(view, goal, gripper=gripper, speed=speed)
    return False


@dataclass(frozen=True, eq=False, kw_only=True)
class HandMove:
    """A straight motion of the tcp, by differential inverse kinematics over arm and torso.

    Attributes:
        pos: (3,) goal position in the world [m].
        rot: (3, 3) goal rotation in the world.
        gripper: gripper command, from `CLOSED` to `OPEN`.
        speed: translation speed [m/s].
        turn: rotation speed [rad/s].
        tolerance: distance to the goal at which the motion ends [m].
        angle_tolerance: angle to the goal rotation at which the motion ends [rad].
        max_steps: control steps after which the motion gives up.
        rest: (J,) posture preferred in the null space, None for the present one.
        drive: forward speed [m/s] and yaw rate [rad/s] of the base meanwhile; the arm compensates them.
        torso: whether the torso may move.
        stop_on_force: the motion gives up when the contact forces on the robot's links sum up to more [N].
    """

    pos: np.ndarray
    rot: np.ndarray
    gripper: float
    speed: float = 0.25
    turn: float = 1.0
    tolerance: float = 0.008
    angle_tolerance: float = 0.1
    max_steps: int = 80
    rest: np.ndarray | None = None
    drive: tuple[float, float] = (0.0, 0.0)
    torso: bool = True
    stop_on_force: float = np.inf


def move_tcp(view: WorldView, move: HandMove) -> Motion:
    """Move the tcp on a straight line to a pose. Returns whether it arrived."""
    # The present posture pulls least.
    rest = view.q if move.rest is None else move.rest
    dofs = ik.columns(view.robot.chain, torso=move.torso)
    now, now_rot = tcp(view)
    carrot = now[None]
    carrot_rot = now_rot[None]
    for _ in range(move.max_steps):
        here, here_rot = tcp(view)
        off = np.linalg.norm(move.pos - here)
        if (
            off <= move.tolerance
            and angle_between(here_rot, move.rot) <= move.angle_tolerance
        ):
            return True
        # Pressed against furniture, the servo would only press harder.
        if view.link_forces.sum() > move.stop_on_force:
            return False
        # The aim moves at the wanted speed, but stays within 6 cm of the present tcp position.
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
        goals = ik.TipGoals(aim[None], carrot_rot, dofs, rest)
        yield hand_action(view, goals, gripper=move.gripper, drive=move.drive)
    return False


def still_tcp(
    view: WorldView,
    pos: np.ndarray,
    rot: np.ndarray,
    *,
    gripper: float,
    steps: int,
    until: Until = never,
) -> Motion:
    """Hold the tcp at a pose near the present one.

    Args:
        view: the world.
        pos: (3,) position in the world [m].
        rot: (3, 3) rotation in the world.
        gripper: gripper command.
        steps: control steps.
        until: condition that ends the motion earlier.
    """
    dofs = ik.columns(view.robot.chain, torso=False)
    for _ in range(steps):
        if until(view):
            return True
        goals = ik.TipGoals(pos[None], rot[None], dofs, view.q)
        yield hand_action(view, goals, gripper=gripper)
    return True


def raise_tcp(
    view: WorldView,
    pos: np.ndarray,
    rot: np.ndarray,
    *,
    rest: np.ndarray,
    max_steps: int = 16,
) -> Motion:
    """Move the tcp with a held object to a pose nearby, slowly at first: a jerk would shift the object in the fingers.

    Args:
        view: the world.
        pos: (3,) goal position in the world [m].
        rot: (3, 3) goal rotation in the world.
        rest: (J,) posture preferred in the null space.
        max_steps: control steps at full speed after which the motion gives up.

    Returns:
        Whether the tcp arrived.
    """
    # A short lift must not count as done before it has begun.
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
    """Present forward speed [m/s] and yaw rate [rad/s] of the base."""
    v_x, v_y, turn = view.qd[BASE]
    yaw = float(view.base[2])
    return float(np.cos(yaw) * v_x + np.sin(yaw) * v_y), float(turn)


def base_motion(yaw: float, drive: tuple[float, float]) -> np.ndarray:
    """Motion (1, 3) x, y [m], yaw [rad] of a base at heading ``yaw`` in one control step at speeds ``drive``."""
    step = drive[0] * STEP_SECONDS
    return np.array([[*(step * ahead(yaw)), drive[1] * STEP_SECONDS]])


def ahead(yaw: float) -> np.ndarray:
    """Unit vector (2,) in the direction of a heading [rad]."""
    return np.array([np.cos(yaw), np.sin(yaw)])


def ahead_3d(yaw: float) -> np.ndarray:
    """The same with a third component of 0: no height, or no turn of a base pose."""
    return np.array([np.cos(yaw), np.sin(yaw), 0.0])


def angle_between(now: np.ndarray, goal: np.ndarray) -> float:
    """Angle [rad] between two rotations (3, 3)."""
    # Rounding can bring the trace beyond 3.
    return float(np.arccos(np.clip((np.trace(now.T @ goal) - 1) / 2, -1.0, 1.0)))


@phase("close the fingers", "grasp")
def close_fingers(
    view: WorldView,
    target: str,
    *,
    steps: int = 12,
    settle: int = 3,
    rate: float = math.inf,
) -> Motion:
    """Close the gripper until both fingers press a target.

    Args:
        view: the world.
        target: name of an object or link.
        steps: control steps after which the motion gives up.
        settle: consecutive control steps with more than 1 N on both fingers that end the motion.
        rate: change of the commanded finger position per control step [m], three times as much once both fingers
            press. The default closes with full force at once; the fingers then meet the target at 0.3 m/s.

    Returns:
        Whether both fingers press the target.
    """
    goal = view.q
    pressed = 0
    # From where the fingers are: a command far ahead would close them at once.
    command = float(view.q[view.robot.columns.fingers].mean())
    for _ in range(steps):
        # Once both fingers press, nothing is shoved aside any more.
        command -= 3.0 * rate if pressed else rate
        yield action(view, goal, gripper=gripper_at(view.robot, 2.0 * command))
        # In a row: a single step of force is the first bounce.
        pressed = pressed + 1 if (view.finger_forces(target) > 1.0).all() else 0
        if pressed >= settle and command <= view.robot.limits.gripper[0]:
            return True
    return False


@phase("move the arm to rest", "retract")
def to_rest(view: WorldView, *, gripper: float, max_steps: int = 120) -> Motion:
    """Move arm, torso and head to the rest configuration. Returns whether arm and torso arrived."""
    return (
        yield from move_joints(
            view, rest_goal(view), gripper=gripper, tolerance=0.02, max_steps=max_steps
        )
    )


def rest_goal(view: WorldView) -> np.ndarray:
    """Rest configuration (J,) at the present base pose.

    Continuous joints are within half a turn of the present, unless a joint at rest after a whole turn counts as
    away from rest (`TaskConfig.endless`): then they are turned back.
    """
    q = view.q
    goal = view.robot.rest.copy()
    # The base stays where it is: rest is about the arm.
    goal[BASE] = q[BASE]
    return ik.unwind(view.robot.chain, goal, q) if any(view.config.endless) else goal


def steps_home(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Control steps (...,) that arm and torso need from configurations ``q`` (..., J) to rest."""
    rest = ik.unwind(robot.chain, robot.rest, q)
    return ik.travel_steps(robot.chain, q, rest, ik.columns(robot.chain))


@phase("stay at rest", "hold")
def stay_at_rest(view: WorldView, *, gripper: float) -> Motion:
    """Hold the rest configuration; never ends by itself."""
    goal = rest_goal(view)
    while True:
        yield action(view, goal, gripper=gripper)


def joint_gap(view: WorldView, goal: np.ndarray) -> float:
    """Largest distance of an arm joint from ``goal`` (J,) [rad], or three times that of the torso [m] if larger."""
    off = np.abs(goal - view.q)
    arm = float(off[list(view.robot.arm_columns)].max())
    # Metres count more than radians: a centimetre of the torso is a centimetre at the hand.
    return max(arm, 3.0 * float(off[list(view.robot.torso_columns)].max(initial=0.0)))


def _arm_and_torso(robot: Robot) -> list[int]:
    return [*robot.arm_columns, *robot.torso_columns]


def drives(view: WorldView, xy: np.ndarray, yaw: float) -> bool:
    """Whether the base has to move to be at ``xy`` (2,) [m] with heading ``yaw`` [rad], within 15 mm and 0.03 rad."""
    turn = (yaw - view.base[2] + np.pi) % (2 * np.pi) - np.pi
    return bool(np.linalg.norm(xy - view.base[:2]) > 0.015 or abs(turn) > 0.03)
