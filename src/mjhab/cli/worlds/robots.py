"""``mjhab robots``: list and describe robots."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

from mjhab.cli.output import Listing, report
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import take_options


@dataclass(frozen=True)
class RobotsListSpec:
    """List the robots: number of joints, widths of an action (default control mode) and of `state`, and availability.

    A robot is available if the files that it is made of are installed.
    """


@dataclass(frozen=True)
class RobotsShowSpec:
    """Show the joints of a robot with their groups and limits, and its cameras.

    For instance: `mjhab robots show fetch`
    """

    robot: Annotated[str, Flag(positional=True)]
    """Name of the robot (see: mjhab robots list)."""

    def __post_init__(self) -> None:
        take_options(self)


def list_robots(spec: RobotsListSpec, json: bool) -> int:
    """Print the robots."""
    rows = robot_rows()
    heads = ("name", "joints", "action", "state", "available")
    sizes = ("name", "dofs", "action_dim", "state_dim")
    shown = [
        (*(row[key] for key in sizes), "yes" if row["available"] else "no")
        for row in rows
    ]
    report(
        json,
        {"robots": rows},
        Listing("robots", heads, shown),
        *(row["missing"] for row in rows),
        'mjhab.make(robot="NAME", ...); --robot NAME of eval and generate',
    )
    return 0


def show_robot(spec: RobotsShowSpec, json: bool) -> int:
    """Print joints and cameras of one robot."""
    from mjhab.robots.registry import robot_named

    robot = robot_named(spec.robot)
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
    rows = [tuple("" if v is None else v for v in row.values()) for row in joints]
    report(
        json,
        {"name": robot.name, "joints": joints, "cameras": cameras},
        Listing(f"joints of {robot.name}", tuple(joints[0]), rows),
        "cameras: " + ", ".join(cameras),
    )
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
