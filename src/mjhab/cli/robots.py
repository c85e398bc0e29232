"""``mjhab robots``: which robots there are."""

from __future__ import annotations

from typing import Any

from mjhab.cli.options.env import RobotsListOptions
from mjhab.cli.output import print_json, print_table


def run_robots(options: RobotsListOptions) -> int:
    """Print the robots and return the exit code."""
    rows = robot_rows()
    if options.json:
        print_json({"robots": rows})
        return 0
    heads = ("name", "joints", "action", "state")
    print_table("robots", heads, [tuple(row.values()) for row in rows])
    print('mjhab.make(robot="NAME", ...); --robot NAME of eval and generate')
    return 0


def robot_rows() -> list[dict[str, Any]]:
    """Name of every robot, its number of joints, and the sizes of an action and of the observation ``state``."""
    from mjhab.envs.observations import state_dim
    from mjhab.robots.registry import ROBOTS

    return [
        {
            "name": robot.name,
            "dofs": len(robot.joints),
            "action_dim": robot.action.dim,
            "state_dim": state_dim(robot),
        }
        for robot in ROBOTS.values()
    ]
