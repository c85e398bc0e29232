"""Compiling what the experts plan with before it is needed."""

from __future__ import annotations

import numpy as np

from mjhab.core.boxes import Boxes, nearest_box_distance
from mjhab.envs.parts.world_view import REST_QPOS
from mjhab.experts.arm import gentle, ik, motion
from mjhab.experts.base.pilot import Pilot, simulate


def compile_kernels() -> None:
    """Call every kernel of the planning once; those that are on disk are only loaded."""
    robot = motion.chain()
    dofs = ik.columns(robot)
    seeds = REST_QPOS[None]
    pos, rot = robot.tip_pose(REST_QPOS)
    ik.solve(robot, pos, rot, seeds, dofs, rest=REST_QPOS)
    ik.servo(robot, seeds, pos, rot, dofs, rest=REST_QPOS)
    boxes = Boxes.of(np.zeros((1, 3)), 0.1)
    motion.spheres().clearance(seeds, boxes)
    motion.spheres().self_clearance(seeds)
    nearest_box_distance(pos, boxes)
    path = np.array([[0.0, 0.0], [1.0, 0.0]])
    Pilot(path, 0.0, 1, 0.2).step(np.zeros(3))
    simulate(np.zeros(3), path, 0.0, 1, 0.2, gentle.FIRM)
    gentle.eased((1.0, 0.0), (0.0, 0.0), gentle.FIRM)
