"""Simulate a start state until it is at rest, outside the batch of worlds."""

from __future__ import annotations

import mujoco
import numpy as np

from mjhab.core.joints import BASE_XY
from mjhab.layout.addresses import Addresses
from mjhab.robots.robot import Robot

ROBOT_PARKING = (19.0, 19.0)
"""Base position x, y [m] of the robot while objects settle: outside of every home, within the base joints' range."""


def parked_robot_qpos(robot: Robot) -> np.ndarray:
    """Return (J,) joint positions [m, rad]: the rest posture with the base at ROBOT_PARKING."""
    q = robot.rest.copy()
    q[BASE_XY] = ROBOT_PARKING
    return q


def settle(
    model: mujoco.MjModel, a: Addresses, qpos: np.ndarray, seconds: float = 1.5
) -> tuple[np.ndarray, float]:
    """Simulate for ``seconds`` from ``qpos`` (nq,) with zero velocity and the robot parked.

    Args:
        model: compiled home.
        a: addresses of its layout.
        qpos: (nq,) start; its robot joints are ignored.
        seconds: simulated time [s].

    Returns:
        (nq,) final positions, and the largest absolute velocity component of any object at the end [m/s or rad/s].
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    # Away, so that no object comes to rest against it.
    data.qpos[a.robot_q] = parked_robot_qpos(a.robot)
    # With ctrl 0 the position servos would drive every joint to 0.
    hold_robot(model, data)
    steps = round(seconds / model.opt.timestep)
    mujoco.mj_step(model, data, steps)
    speed = (
        np.abs(data.qvel[a.object_v[:, None] + np.arange(6)]).max()
        if len(a.object_v)
        else 0.0
    )
    # A view would keep all of MuJoCo's data alive.
    return data.qpos.copy(), float(speed)


def holding_ctrl(model: mujoco.MjModel, robot: Robot, qpos: np.ndarray) -> np.ndarray:
    """Return the actuator commands (n, nu) with which episodes start in the states ``qpos`` (n, nq).

    Position servos hold their joints, velocity servos stand still, and the fingers are commanded closed, so that a held
    object is gripped from the first substep on.
    """
    joints = model.actuator_trnid[:, 0]
    out = np.where(
        # A servo with stiffness takes a position, one without a speed.
        model.actuator_biasprm[:, 1] != 0.0,
        qpos[:, model.jnt_qposadr[joints]],
        0.0,
    )
    # Actuators have the order of the joints, so that columns of one are those of the other.
    out[:, list(robot.finger_columns)] = robot.limits.gripper[0]
    return out


def hold_robot(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Set ``data.ctrl``: position servos hold the present joint positions, velocity servos get speed 0."""
    at = data.qpos[model.jnt_qposadr[model.actuator_trnid[:, 0]]]
    data.ctrl[:] = np.where(model.actuator_biasprm[:, 1] != 0.0, at, 0.0)
