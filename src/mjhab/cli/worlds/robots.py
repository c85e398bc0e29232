"""``mjhab robots``: list and describe robots."""

from __future__ import annotations

import math
from typing import Any

from mjhab.cli.options.env import RobotsListOptions, RobotsShowOptions
from mjhab.cli.output import print_json, print_table


def run_robots(options: RobotsListOptions | RobotsShowOptions) -> int:
    """Run one of the commands and return the exit code."""
    return (
        list_robots(options)
        if isinstance(options, RobotsListOptions)
        else show_robot(options)
    )


def list_robots(options: RobotsListOptions) -> int:
    """Print the robots."""
    rows = robot_rows()
    if options.json:
        print_json({"robots": rows})
        return 0
    heads = ("name", "joints", "action", "state", "available")
    sizes = ("name", "dofs", "action_dim", "state_dim")
    shown = [
        (*(row[key] for key in sizes), "yes" if row["available"] else "no")
        for row in rows
    ]
    print_table("robots", heads, shown)
    for row in rows:
        if row["missing"]:
            print(row["missing"])
    print('mjhab.make(robot="NAME", ...); --robot NAME of eval and generate')
    return 0


def show_robot(options: RobotsShowOptions) -> int:
    """Print joints and cameras of one robot."""
    from mjhab.robots.registry import robot_named

    robot = robot_named(options.robot)
    group_of = {
        joint: group for group, joints in robot.groups.items() for joint in joints
    }
    joints = [
        {
            "name": name,
            "group": group_of[name],
            "unit": "m" if name in robot.sliding else "rad",
            "low": low if math.isfinite(low) else None,
            "high": high if math.isfinite(high) else None,
            "rest": rest,
        }
        for name, (low, high), rest in zip(
            robot.joints, robot.joint_limits, robot.rest_qpos, strict=True
        )
    ]
    cameras = list(robot.camera_names)
    if options.json:
        print_json({"name": robot.name, "joints": joints, "cameras": cameras})
        return 0
    rows = [tuple("" if v is None else v for v in row.values()) for row in joints]
    print_table(f"joints of {robot.name}", tuple(joints[0]), rows)
    print("cameras: " + ", ".join(cameras))
    return 0


def robot_rows() -> list[dict[str, Any]]:
    """Facts about every robot.

    Returns:
        One row per robot: ``name``; ``dofs``, its number of joints; ``action_dim`` and ``state_dim``, widths of an
        action and of the observation ``state``; ``available``, whether its files are installed; ``missing``, the
        message that names the command which installs them, "" if available.
    """
    from mjhab.envs.observations.state import state_dim
    from mjhab.robots.availability import missing_files
    from mjhab.robots.registry import ROBOTS

    rows = []
    for robot in ROBOTS.values():
        missing = missing_files(robot)
        rows.append(
            {
                "name": robot.name,
                "dofs": len(robot.joints),
                "action_dim": robot.action.dim,
                "state_dim": state_dim(robot),
                "available": not missing,
                "missing": missing,
            }
        )
    return rows
