"""Poses of bodies and contacts of the robot, computed from generalized positions, and their interpolation."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from mjhab.core.rotations import yaw_from_quat
from mjhab.robots.robot import Robot
from mjhab.sim.mujoco.cpu import CpuSimulator

MAX_JUMP_M = 0.25
"""A body that moves farther in one control step was teleported: its positions are not interpolated."""
MIN_HEIGHT_M = -5.0
"""Bodies below this height are parked: the home does not have them."""


@dataclass(frozen=True, eq=False)
class PosedWorld:
    """World poses of the bodies of one world: pos (B, 3) [m], quat (B, 4) wxyz.

    contacts: (C, 3) positions of contacts between the robot and other things [m].
    """

    pos: np.ndarray
    quat: np.ndarray
    contacts: np.ndarray

    @property
    def parked(self) -> np.ndarray:
        """(B,) bool: bodies that the home does not have."""
        return self.pos[:, 2] < MIN_HEIGHT_M


def base_of(pose: PosedWorld, sim: CpuSimulator) -> np.ndarray:
    """Return the pose (3,) of the robot's base: x, y [m] and yaw [rad]."""
    body = sim.addresses.robot_body[sim.layout.robot.base_link]
    return np.append(pose.pos[body, :2], yaw_from_quat(pose.quat[body]))


class Poser:
    """Compute poses in the homes of a simulator, with its own `MjData`: its worlds are neither read nor changed.

    Args:
        sim: has the compiled homes.
    """

    def __init__(self, sim: CpuSimulator) -> None:
        self._sim = sim
        self._home = ""
        self._data: mujoco.MjData | None = None
        self._robot = np.zeros(0, bool)

    def pose(self, home: str, qpos: np.ndarray) -> PosedWorld:
        """Compute the pose of all bodies, and the robot's contacts, for generalized positions ``qpos`` (nq,)."""
        model = self._sim.model(home)
        if self._data is None or home != self._home:
            self._data = mujoco.MjData(model)
            self._home = home
            self._robot = _robot_bodies(model, self._sim.layout.robot)
        data = self._data
        assert data is not None
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        # The collision detection below needs what this computes.
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        return PosedWorld(
            data.xpos.copy(), data.xquat.copy(), self._contacts(model, data)
        )

    def _contacts(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """(C, 3) positions [m] of penetrating contacts between the robot and other geoms (it does not touch floors)."""
        geoms = data.contact.geom
        # Flexible bodies have -1, and within a margin there are contacts without touch.
        touching = (geoms >= 0).all(axis=1) & (data.contact.dist < 0.0)
        ours = self._robot[model.geom_bodyid[np.maximum(geoms, 0)]]
        return data.contact.pos[touching & (ours[:, 0] != ours[:, 1])].copy()


def _robot_bodies(model: mujoco.MjModel, spec: Robot) -> np.ndarray:
    """(B,) bool: the links of the robot whose contacts count."""
    names = (*spec.force_links, *spec.finger_links)
    robot = np.zeros(model.nbody, bool)
    robot[[model.body(name).id for name in names]] = True
    return robot


def between(a: PosedWorld, b: PosedWorld, share: float) -> PosedWorld:
    """Interpolate from ``a`` to ``b`` at ``share`` (0 to 1); bodies that jump stay at ``a`` until ``share`` is 1."""
    jumped = np.linalg.norm(b.pos - a.pos, axis=1) > MAX_JUMP_M
    weight = np.where(jumped, np.floor(share), share)[:, None]
    # Both signs are the same rotation: the nearer one turns the short way round.
    sign = np.where((a.quat * b.quat).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    quat = (1.0 - weight) * a.quat + weight * sign * b.quat
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    pos = a.pos + weight * (b.pos - a.pos)
    return PosedWorld(pos, quat, b.contacts if share >= 0.5 else a.contacts)
