"""Compilation of the experts' planning kernels ahead of the first episode."""

from __future__ import annotations

import numpy as np

from mjhab.core.boxes import Boxes, nearest_box_distance
from mjhab.experts.arm import ik, motion
from mjhab.experts.base.follower import Follower, PathSegment, simulate
from mjhab.robots.registry import robot_named


def compile_kernels() -> None:
    """Call every planning kernel once, so that it is compiled or loaded from the cache on disk."""
    body = robot_named()
    robot = body.chain
    rest = body.rest
    dofs = ik.columns(robot)
    seeds = rest[None].copy()
    pos, rot = robot.tip_pose(rest)
    ik.solve(robot, ik.TipGoals(pos, rot, dofs, rest), seeds)
    ik.servo(robot, seeds, ik.TipGoals(pos, rot, dofs, rest))
    boxes = Boxes.of(np.zeros((1, 3)), 0.1)
    motion.spheres(body).clearance(seeds, boxes)
    motion.spheres(body).self_clearance(seeds)
    nearest_box_distance(pos, boxes)
    segments = [PathSegment(np.array([[0.0, 0.0], [1.0, 0.0]]), 1, 0.0)]
    Follower(segments, 0.2).step(np.zeros(3))
    simulate(np.zeros(3), segments, 0.2)
