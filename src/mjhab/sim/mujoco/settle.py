"""Simulate a start state until it is at rest, outside the batch of worlds."""

from __future__ import annotations

import mujoco
import numpy as np

from mjhab.core.joints import BASE_XY
from mjhab.layout.layout import Addresses
from mjhab.robots.robot import Robot

ROBOT_PARKING = (19.0, 19.0)
"""Base position [m] of the robot while a home settles: beyond every home, inside the base's joint range."""


def parked_robot_qpos(robot: Robot) -> np.ndarray:
    """(J,) rest pose with the base out of the way."""
    q = robot.rest.copy()
    q[BASE_XY] = ROBOT_PARKING
    return q


def settle(
    model: mujoco.MjModel, a: Addresses, qpos: np.ndarray, seconds: float = 1.5
) -> tuple[np.ndarray, float]:
    """Simulate from ``qpos`` (nq,) at rest with the robot parked.

    Returns:
        The positions (nq,) afterwards, and the largest object speed [m/s or rad/s] left at the end.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    data.qpos[a.robot_q] = parked_robot_qpos(a.robot)
    # The finger servos would drive to 0 m; every other servo is held where it is.
    hold_robot(model, data)
    steps = round(seconds / model.opt.timestep)
    mujoco.mj_step(model, data, steps)
    speed = np.abs(data.qvel[a.object_v[:, None] + np.arange(6)]).max() if len(a.object_v) else 0.0
    return data.qpos.copy(), float(speed)


def holding_ctrl(model: mujoco.MjModel, robot: Robot, qpos: np.ndarray) -> np.ndarray:
    """Commands (n, nu) at the start of an episode in the states ``qpos`` (n, nq).

    Servos hold and fingers squeeze, so that the forces of the start are those of a robot that keeps what it has.
    """
    joints = model.actuator_trnid[:, 0]
    out = np.where(model.actuator_biasprm[:, 1] != 0.0, qpos[:, model.jnt_qposadr[joints]], 0.0)
    out[:, list(robot.finger_columns)] = robot.limits.gripper[0]
    return out


def hold_robot(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Command every position servo to stay where its joint is, and the base to stand still."""
    at = data.qpos[model.jnt_qposadr[model.actuator_trnid[:, 0]]]
    data.ctrl[:] = np.where(model.actuator_biasprm[:, 1] != 0.0, at, 0.0)
