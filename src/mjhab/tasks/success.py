"""When a subtask is done: one function per kind, on boolean arrays (W,).

Conditions of the MS-HAB paper (App. A.2) and mshab/envs/sequential_task.py. ``force_ok`` means that the force
accumulated over the subtask is within its limit; a subtask with too much force cannot succeed.
"""

from __future__ import annotations

from mjhab.core.arrays import Array


def pick_success(is_grasped: Array, ee_rest: Array, robot_rest: Array, is_static: Array, force_ok: Array) -> Array:
    """The object is held and the robot is back at rest (loosely), not moving."""
    return is_grasped & ee_rest & robot_rest & is_static & force_ok


def place_success(
    is_grasped: Array, at_goal: Array, ee_rest: Array, robot_rest: Array, is_static: Array, force_ok: Array
) -> Array:
    """The object lies at its goal, let go, and the robot is back at rest, not moving."""
    return ~is_grasped & at_goal & ee_rest & robot_rest & is_static & force_ok


def open_success(opened: Array, ee_rest: Array, robot_rest: Array, is_static: Array, force_ok: Array) -> Array:
    """The link is open and the robot is back at rest, not moving."""
    return opened & ee_rest & robot_rest & is_static & force_ok


def close_success(closed: Array, ee_rest: Array, robot_rest: Array, is_static: Array, force_ok: Array) -> Array:
    """The link is closed and the robot is back at rest, not moving."""
    return closed & ee_rest & robot_rest & is_static & force_ok


def navigate_success(
    near: Array,
    oriented: Array,
    hold_ok: Array,
    ee_rest: Array,
    robot_rest: Array,
    is_static: Array,
    force_ok: Array,
    ignore_arm: bool,
) -> Array:
    """The base stands close to the goal and faces it, not moving.

    Args:
        hold_ok: (W,) the object to carry is in the hand, or none has to be.
        ignore_arm: drop the conditions on arm and grasp (used with teleport navigation).
    """
    arrived = near & oriented & is_static & force_ok
    return arrived if ignore_arm else arrived & hold_ok & ee_rest & robot_rest
