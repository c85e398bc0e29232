"""Rows of the state: joints, tcp, and object, goal and grasp of the active subtask (mshab/envs/sequential_task.py).

``state`` (W, S) is the concatenation of these rows, see `state_dim`. Rows that the active subtask does not use are
zero, so that one policy interface serves all subtasks. With the mode "proprioception" ``state`` holds the
measurements of the robot's own sensors instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

from mjhab.core.arrays import Array, constant, empty, indices, join_as, namespace
from mjhab.core.joints import BASE_XY, BASE_YAW
from mjhab.core.rotations import quat_canonical
from mjhab.envs.observations.entry import ObsContext, ObsEntry
from mjhab.envs.observations.modes import STATE_KEY
from mjhab.robots.robot import Robot
from mjhab.tasks.subtasks.registry import SUBTASKS
from mjhab.tasks.subtasks.spec import SubtaskSpec


def pose_in_base(base: Array, height: float, pose: Array) -> Array:
    """Transform world poses to the frame of the base link.

    Quaternions become canonical (w >= 0), because the sign of a simulator's quaternion depends on its history.

    Args:
        base: (W, 3) x, y [m], yaw [rad] of the base.
        height: height of the base link above the floor [m].
        pose: (..., W, 7) xyz [m] + wxyz in the world.
    """
    # The base turns about z only: half of the terms of the quaternion product are zero and left out.
    xp = namespace(base)
    # One operation for all columns: on the host the time of a control step is the number of small operations.
    yaw = base[:, BASE_YAW][:, None]
    half = 0.5 * yaw
    xy = pose[..., :2] - base[:, BASE_XY]
    quat = pose[..., 3:]
    # Signs by a constant, so that both columns are one product.
    across = xp.sin(yaw) * constant((1.0, -1.0), pose)
    turn = xp.sin(half) * constant((1.0, 1.0, -1.0, -1.0), pose)
    out = empty(pose.shape, pose)
    out[..., :2] = xp.cos(yaw) * xy + across * xy[..., indices((1, 0), pose)]
    out[..., 2] = pose[..., 2] - height
    out[..., 3:] = quat_canonical(
        xp.cos(half) * quat + turn * quat[..., indices((3, 2, 1, 0), pose)]
    )
    return out


OBJECT_KEY = "extra/obj_pose_wrt_base"
GOAL_KEY = "extra/goal_pos_wrt_base"
GRASP_KEY = "extra/is_grasped"
_OBJECT_IN = {
    "object": "its object",
    "link": "the object behind the link",
    "way": "the object in the hand, zero without one",
}
_GOAL_IN = {
    "object": "where its object goes",
    "link": "the handle",
    "way": "where the way leads",
}
_GRASPED_IN = {
    "object": "its object",
    "link": "the handle",
    "way": "the object in the hand",
}
"""Meaning of the task rows for each `SubtaskSpec.about`."""


def task_meanings(kinds: Sequence[str]) -> dict[str, str]:
    """Describe the task rows for some kinds of subtasks, by key; from `SubtaskSpec.shows` and ``about``.

    Raises:
        UsageError: there is no such subtask.
    """
    specs = [SUBTASKS[kind] for kind in kinds]
    return {
        key: f"{_listed(about, [s for s in specs if part in (*s.shows, '')], specs)} ({numbers}); "
        "zero once the plan is finished"
        for key, numbers, part, about in (
            (
                OBJECT_KEY,
                "position, quaternion with w >= 0, in the axes of object_axes",
                "object",
                _OBJECT_IN,
            ),
            (GOAL_KEY, "position", "goal", _GOAL_IN),
            (GRASP_KEY, "1 while both fingers hold it", "", _GRASPED_IN),
        )
    }


def _listed(
    about: Mapping[str, str],
    shown: Sequence[SubtaskSpec],
    all_kinds: Sequence[SubtaskSpec],
) -> str:
    """Meaning of one row for several kinds, as in "Pick, Place: its object; Open: the handle; zero in Navigate"."""
    by_meaning: dict[str, list[str]] = {}
    for spec in shown:
        by_meaning.setdefault(about[spec.about], []).append(spec.name.capitalize())
    sentences = [
        f"{', '.join(names)}: {meaning}" for meaning, names in by_meaning.items()
    ]
    hidden = [spec.name.capitalize() for spec in all_kinds if spec not in shown]
    if hidden:
        sentences.append(f"zero in {', '.join(hidden)}")
    return "; ".join(sentences)


def joint_rows(robot: Robot) -> tuple[ObsEntry, ...]:
    """Rows of the joints of a robot, without those of its base."""
    upper = robot.columns.upper
    count = upper.stop - upper.start
    groups = [
        group for group in ("torso", "head", "arm", "fingers") if robot.group(group)
    ]
    frame = f"joint: {', '.join(groups)}"
    return (
        ObsEntry(
            "agent/qpos",
            (count,),
            "m, rad",
            frame,
            lambda c: c.robot_q[:, upper],
            "joint positions without the base; those of joints without limits as joint_angles says",
        ),
        ObsEntry(
            "agent/qvel",
            (count,),
            "m/s, rad/s",
            frame,
            lambda c: c.robot_qd[:, upper],
            "joint velocities without the base",
        ),
    )


def task_rows(robot: Robot) -> tuple[ObsEntry, ...]:
    """Rows of the tcp and of object, goal and grasp of the active subtask."""
    base = robot.base_link
    return (
        ObsEntry(
            "extra/tcp_pose_wrt_base",
            (7,),
            "m, wxyz",
            base,
            lambda c: c.tcp_pose,
            f"{robot.tcp}: position, quaternion with w >= 0",
        ),
        ObsEntry(
            OBJECT_KEY,
            (7,),
            "m, wxyz",
            base,
            lambda c: c.obj_pose,
            "object of the active subtask, w >= 0; zero once the plan is finished",
        ),
        ObsEntry(
            GOAL_KEY,
            (3,),
            "m",
            base,
            lambda c: c.goal_pos,
            "goal of the active subtask; zero once the plan is finished",
        ),
        ObsEntry(
            GRASP_KEY,
            (1,),
            "0 or 1",
            "-",
            lambda c: c.is_grasped[:, None],
            "what the active subtask is about is grasped; zero once the plan is finished",
        ),
    )


def base_velocity_row(robot: Robot) -> ObsEntry:
    """Row of the velocity of the base in its own frame, as odometry measures it."""
    return ObsEntry(
        BASE_VELOCITY_KEY,
        (3,),
        "m/s, rad/s",
        robot.base_link,
        _base_velocity,
        "velocity of the base: forward, to the left, yaw rate",
    )


@lru_cache(maxsize=16)
def state_table(robot: Robot, own: bool = False) -> tuple[ObsEntry, ...]:
    """The entries of ``state``, in order; ``own``: those of the mode "proprioception"."""
    tcp, *task = task_rows(robot)
    # Odometry in place of object and goal: it is what the robot measures itself.
    if own:
        return (*joint_rows(robot), base_velocity_row(robot), tcp)
    return (*joint_rows(robot), tcp, *task)


def state_dim(robot: Robot, own: bool = False) -> int:
    """Length of ``state``; ``own``: in the mode "proprioception"."""
    return sum(entry.shape[0] for entry in state_table(robot, own))


def unsensed_table(robot: Robot) -> tuple[ObsEntry, ...]:
    """The entries of ``state`` that no sensor of the robot measures: object, goal, grasp."""
    own = {entry.key for entry in state_table(robot, own=True)}
    return tuple(entry for entry in state_table(robot) if entry.key not in own)


def unsensed_dim(robot: Robot) -> int:
    """Number of values of `unsensed_table`."""
    return sum(entry.shape[0] for entry in unsensed_table(robot))


BASE_VELOCITY_KEY = "agent/base_vel"


def _base_velocity(context: ObsContext) -> Array:
    yaw = context.robot_q[:, BASE_YAW]
    xp = namespace(yaw)
    c = xp.cos(yaw)
    s = xp.sin(yaw)
    velocity = context.robot_qd[:, BASE_XY]
    # The joints of the base are along the axes of the world.
    ahead = c * velocity[:, 0] + s * velocity[:, 1]
    left = c * velocity[:, 1] - s * velocity[:, 0]
    return xp.stack([ahead, left, context.robot_qd[:, BASE_YAW]], axis=1)


def state_observation(table: Sequence[ObsEntry], context: ObsContext) -> dict[str, Array]:
    """Every entry of a `state_table` and their concatenation, float32, (W, ...); the entries are views of it."""
    float32 = namespace(context.robot_q).float32
    # One array, of which the entries are views: they cost nothing.
    state = join_as([entry.compute(context) for entry in table], float32)
    obs = {}
    column = 0
    for entry in table:
        obs[entry.key] = state[:, column : column + entry.shape[0]]
        column += entry.shape[0]
    obs[STATE_KEY] = state
    return obs
