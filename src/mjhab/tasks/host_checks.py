"""`measure.check_body` on the host, compiled: the same bits in a few calls instead of some sixty on small arrays.

Imported only where environments step, because it loads numba.
"""

from __future__ import annotations

import math

import numpy as np

from mjhab.core.conventions.changes import turns
from mjhab.core.joints import BASE_YAW
from mjhab.core.kernels.control_step import check_hand, check_joints
from mjhab.tasks.measure import BodyChecks, speed_limits
from mjhab.tasks.signals import Active, WorldState
from mjhab.tasks.thresholds import TaskConfig


class HostBodyCheck:
    """`measure.check_body` for numpy arrays in float64.

    Args:
        config: the thresholds that it will be called with.
    """

    def __init__(self, config: TaskConfig) -> None:
        self._posture = config.joints.posture
        self._body = config.joints.body
        x, y, z = config.ee_rest_pos
        height = config.base_height + z
        # The cosine once: the kernel compares it with a product in place of an angle per step.
        grip = (math.cos(config.grasp_angle), config.grasp_force)
        self._hand = np.array([*grip, x, y, height, config.ee_rest_tol])
        # Of one type, because the kernels have a single compiled signature.
        self._rest = np.array(config.rest_qpos[self._posture], float)
        endless = config.endless[self._posture] or (False,) * len(self._rest)
        self._per_turn = np.array(turns(endless))
        self._limits = np.array(speed_limits(config), float)
        self._absolute = config.stillness == "absolute"

    def __call__(
        self, state: WorldState, active: Active, config: TaskConfig
    ) -> BodyChecks:
        """See `measure.check_body`; ``config`` is the one of the constructor."""
        yaw = state.base_pose[:, BASE_YAW]
        worlds = len(yaw)
        found = np.empty((5, worlds), bool)
        force = np.empty(worlds)
        check_hand(
            state.finger_force,
            state.held_force,
            state.finger_dir,
            active.navigate,
            state.tcp_pos,
            state.base_pose,
            # By numpy and not inside: compiled sine and cosine have other last bits.
            np.concatenate((np.cos(yaw), np.sin(yaw))),
            self._hand,
            found[:3],
            force,
        )
        check_joints(
            state.robot_q[:, self._posture],
            state.robot_qd[:, self._body],
            active.rest_tol,
            self._rest,
            self._per_turn,
            self._limits,
            self._absolute,
            found[3:],
        )
        is_grasped, contact, ee_rest, robot_rest, is_static = found
        return BodyChecks(is_grasped, contact, force, ee_rest, robot_rest, is_static)
