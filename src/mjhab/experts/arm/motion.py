"""Motions of one robot as scripts: generators that yield one 13-D action per control step.

A script reads its world through a `WorldView` before each action, so every motion is closed-loop. Scripts compose with
``yield from``; each motion gives up after a bounded number of steps and says in its return value whether it arrived.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from functools import lru_cache

import numpy as np

from mjhab.core.rotations import mat_from_quat
from mjhab.envs.parts.world_view import (
    DISTAL_LINKS,
    FETCH_JOINTS,
    KINEMATIC_TREE,
    REST_QPOS,
    ROBOT_GEOMS,
    TRUNK_LINKS,
    HomeShapes,
    WorldView,
)
from mjhab.experts.arm import ik
from mjhab.experts.arm.clearance import RobotSpheres
from mjhab.experts.base.navigation import DriveLimits, Follower, Planner
from mjhab.robots.controllers.actions import (
    ACTION_DIM,
    ARM_JOINTS,
    BASE_FORWARD,
    BASE_YAW,
    GRIPPER,
    HEAD_PAN,
    HEAD_TILT,
    TORSO,
    ActionLimits,
)
from mjhab.robots.kinematics import Chain

Array = np.ndarray
Motion = Generator[Array, None, bool]
LIMITS = ActionLimits()
OPEN = 1.0
CLOSED = -1.0
"""Gripper commands."""
ARM_DELAY = 1.0 - np.exp(-0.5)
"""Share of a commanded delta an arm joint covers in one control step (kp/kd = 10 per second, 50 ms)."""
_ARM = list(ARM_JOINTS)
_FINGERS = [FETCH_JOINTS.index(n) for n in ("r_gripper_finger_joint", "l_gripper_finger_joint")]
_TORSO_Q, _HEAD_PAN_Q, _HEAD_TILT_Q = (
    FETCH_JOINTS.index(n) for n in ("torso_lift_joint", "head_pan_joint", "head_tilt_joint")
)


@lru_cache(maxsize=1)
def chain() -> Chain:
    """Fetch from the base to the tool centre, nothing else (for IK)."""
    return Chain.from_tree(KINEMATIC_TREE, FETCH_JOINTS)


@lru_cache(maxsize=1)
def spheres() -> RobotSpheres:
    """Fetch's links covered by spheres, for clearances."""
    links = tuple(name for name in ROBOT_GEOMS if name not in ("base_link", "gripper_link"))
    full = Chain.from_tree(KINEMATIC_TREE, FETCH_JOINTS, extra=links)
    return RobotSpheres.from_geoms(
        full, ROBOT_GEOMS, skip=("base_link",), trunk=TRUNK_LINKS, distal=DISTAL_LINKS
    )


@lru_cache(maxsize=1)
def arm_spheres() -> RobotSpheres:
    """`spheres` without the trunk, which reaches no farther than the base but for 16 mm at its back: the map keeps both
    clear, and knows the shapes of furniture better than boxes around it do."""
    whole = spheres()
    return whole.only([name for name in whole.chain.links if name not in TRUNK_LINKS])


_PLANNERS: dict[str, tuple[HomeShapes, Planner]] = {}


def planner(home: HomeShapes) -> Planner:
    """Path planner of a home, made once."""
    found = _PLANNERS.get(home.name)
    if found is None or found[0] is not home:
        # There is little time: a base that knows its way needs no wide berth.
        cells = Planner(
            home.map_origin,
            home.map_cell,
            home.map_clearance,
            radius=0.29,
            comfort=0.12,
            caution=2.0,
            narrow=0.27,
        )
        found = (home, cells)
        _PLANNERS[home.name] = found
    return found[1]


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
    """The action that moves arm, head and torso towards the configuration ``goal`` (15,) and the base as told.

    ``drive``: forward speed [m/s], yaw rate [rad/s]. ``speed`` 0..1 bounds the joints; they arrive together.
    """
    out = np.zeros(ACTION_DIM, np.float32)
    out[GRIPPER] = gripper
    out[BASE_FORWARD] = drive[0] / LIMITS.forward
    out[BASE_YAW] = drive[1] / LIMITS.yaw_rate
    if goal is not None:
        wish = (goal - view.q) / LIMITS.joint_delta
        arm = wish[_ARM]
        out[:7] = arm * min(1.0, speed / max(float(np.abs(arm).max()), 1e-9))
        out[[TORSO, HEAD_PAN, HEAD_TILT]] = np.clip(
            wish[[_TORSO_Q, _HEAD_PAN_Q, _HEAD_TILT_Q]], -1.0, 1.0
        )
    return out


def gripper_at(opening: float) -> float:
    """The gripper command that opens the fingers to a width [m]."""
    low, high = LIMITS.gripper
    return float(np.clip((opening - low - high) / (high - low), CLOSED, OPEN))


def hold(view: WorldView, steps: int, *, gripper: float, goal: Array | None = None) -> Motion:
    """Stand still for some steps, keeping the configuration ``goal`` (15,) (default: the present one)."""
    goal = view.q if goal is None else goal
    for _ in range(steps):
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
    """Bring arm, head and torso to ``goal`` (15,) in joint space; the base stands."""
    columns = [*_ARM, _TORSO_Q]
    for _ in range(max_steps):
        if np.abs(goal - view.q)[columns].max() <= tolerance:
            return True
        yield action(view, goal, gripper=gripper, speed=speed)
    return False


def drive_to(
    view: WorldView,
    goal: Array,
    *,
    gripper: float,
    arm: Array | None = None,
    arm_from: float = np.inf,
    limits: DriveLimits | None = None,
    max_steps: int = 120,
    direction: int = 0,
    path: Array | None = None,
) -> Motion:
    """Drive the base to ``goal`` (3,) x, y, yaw around furniture.

    Args:
        arm: configuration (15,) for arm, torso and head during the drive (default: as they are).
        arm_from: move towards ``arm`` only once the goal is this near [m].
        direction: 1 forwards, -1 backwards, 0 whatever is quicker.
        path: way points (P, 2) to follow instead of planned ones.
    """
    if path is None:
        path = planner(view.home).plan(view.q[:2], goal[:2])
        if path is None:
            return False
        if np.linalg.norm(path[-1] - goal[:2]) > 1e-6:
            path = np.concatenate([path, goal[None, :2]])
    follower = Follower(path, float(goal[2]), limits, direction)
    start = view.q
    for _ in range(max_steps):
        step = follower.step(view.q[:3])
        near = np.linalg.norm(view.q[:2] - goal[:2]) <= arm_from
        yield action(
            view,
            arm if arm is not None and near else start,
            gripper=gripper,
            drive=(step.v, step.w),
        )
        if step.done:
            return True
    return False


def move_tcp(
    view: WorldView,
    pos: Array,
    rot: Array,
    *,
    gripper: float,
    speed: float = 0.25,
    turn: float = 1.0,
    tolerance: float = 0.008,
    angle_tolerance: float = 0.1,
    max_steps: int = 80,
    rest: Array | None = None,
    mode: ik.Mode = "pose",
    drive: tuple[float, float] = (0.0, 0.0),
    torso: bool = True,
    stop_on_force: float = np.inf,
) -> Motion:
    """Move the tool centre on a straight line to a pose, by differential IK over arm and torso.

    Args:
        pos, rot: goal (3,), (3, 3) in the world.
        speed, turn: along the way [m/s], [rad/s].
        rest: posture preferred in the null space.
        mode: part of the orientation that counts, see `ik.Mode`.
        drive: forward speed and yaw rate of the base meanwhile; the arm makes up for it.
        stop_on_force: give up when the contact force on the arm exceeds this [N].
    """
    robot = chain()
    rest = view.q if rest is None else rest
    dofs = ik.columns(robot, torso=torso)
    now, now_rot = tcp(view)
    carrot = now[None]
    carrot_rot = now_rot[None]
    for _ in range(max_steps):
        here, here_rot = tcp(view)
        off = np.linalg.norm(pos - here)
        if off <= tolerance and _angle(here_rot, rot, mode) <= angle_tolerance:
            return True
        if view.link_forces.sum() > stop_on_force:
            return False
        # The aim moves at the wanted speed but stays within reach of where the hand really is.
        carrot, carrot_rot = ik.straight_line(
            carrot, pos[None], carrot_rot, rot[None], speed * 0.05, turn * 0.05
        )
        lead = carrot[0] - here
        size = np.linalg.norm(lead)
        aim = here + lead * min(1.0, 0.06 / max(size, 1e-9))
        base_next = view.q[None, :3] + _base_motion(view.q[2], drive)
        delta = ik.servo(
            robot, view.q, aim[None], carrot_rot, dofs, rest=rest, mode=mode, base_next=base_next
        )[0]
        yield action(view, view.q + delta / ARM_DELAY, gripper=gripper, drive=drive)
    return False


def still_tcp(view: WorldView, pos: Array, rot: Array, *, gripper: float, steps: int) -> Motion:
    """Keep the tool centre at a pose (3,), (3, 3) near the present one, until nothing moves any more."""
    robot = chain()
    dofs = ik.columns(robot, torso=False)
    for _ in range(steps):
        delta = ik.servo(robot, view.q, pos[None], rot[None], dofs, rest=view.q)[0]
        yield action(view, view.q + delta / ARM_DELAY, gripper=gripper)
    return True


def raise_tcp(
    view: WorldView, pos: Array, rot: Array, *, rest: Array, max_steps: int = 16
) -> Motion:
    """Bring what the closed hand holds to a pose nearby; gently at first, a jerk would shift it between the pads."""
    near = min(0.02, 0.3 * float(np.linalg.norm(pos - tcp(view)[0])))
    for speed, steps in ((0.05, 1), (0.1, 1), (0.15, 1), (0.25, max_steps)):
        there = yield from move_tcp(
            view,
            pos,
            rot,
            gripper=CLOSED,
            rest=rest,
            speed=speed,
            tolerance=near,
            max_steps=steps,
            torso=False,
        )
        if there:
            return True
    return False


def _base_motion(yaw: float, drive: tuple[float, float]) -> Array:
    step = drive[0] * 0.05
    return np.array([[step * np.cos(yaw), step * np.sin(yaw), drive[1] * 0.05]])


def _angle(now: Array, goal: Array, mode: ik.Mode) -> float:
    if mode == "position":
        return 0.0
    if mode in ("approach", "closing"):
        k = 0 if mode == "approach" else 1
        return float(np.arccos(np.clip(now[:, k] @ goal[:, k], -1.0, 1.0)))
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
    command = float(view.q[_FINGERS].mean())
    for _ in range(steps):
        command -= 3.0 * rate if pressed else rate
        yield action(view, goal, gripper=gripper_at(2.0 * command))
        pressed = pressed + 1 if (view.finger_forces(target) > 1.0).all() else 0
        if pressed >= settle and command <= LIMITS.gripper[0]:
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
    """The rest configuration (15,) next to the present one: continuous joints take the short way."""
    q = view.q
    goal = REST_QPOS.copy()
    goal[:3] = q[:3]
    return ik.unwind(chain(), goal, q)


def steps_home(q: Array) -> Array:
    """Control steps (...,) that the arm needs from configurations (..., 15) to rest."""
    rest = ik.unwind(chain(), REST_QPOS, q)
    return ik.travel_steps(chain(), q, rest, ik.columns(chain()))


def stay_at_rest(view: WorldView, *, gripper: float) -> Motion:
    """Hold the rest pose until the subtask is over."""
    goal = rest_goal(view)
    while True:
        yield action(view, goal, gripper=gripper)


def joint_gap(view: WorldView, goal: Array) -> float:
    """Largest distance of the arm from ``goal`` (15,) [rad]; 1 cm of the torso counts as 0.03 rad."""
    off = np.abs(goal - view.q)
    return float(max(off[_ARM].max(), 3.0 * off[_TORSO_Q]))


def drives(view: WorldView, xy: Array, yaw: float) -> bool:
    """Whether the base has to move to stand at ``xy`` (2,) with heading ``yaw``."""
    turn = (yaw - view.q[2] + np.pi) % (2 * np.pi) - np.pi
    return bool(np.linalg.norm(xy - view.q[:2]) > 0.015 or abs(turn) > 0.03)
