"""A private world per home, for questions that must not disturb the batch: does this touch, does this grasp hold?"""

from __future__ import annotations

import mujoco
import numpy as np

from mjhab.core.rotations import pose_inv, pose_mul
from mjhab.scenes import contact_bits
from mjhab.scenes.fetch import FINGER_LINKS, FINGER_OPEN_DIR, TCP_LINK
from mjhab.sim.cpu import SUBSTEPS, CpuSimulator
from mjhab.sim.settle import hold_robot, parked_robot_qpos

CLOSED_FINGER = -0.01
"""Finger command [m] that squeezes (the gripper action at -1)."""
CLOSING_STEPS = 30
FINGER_JOINTS = slice(13, 15)
FINGER_MAX = 0.05


class Scratch:
    """Scratch worlds of a simulator's homes, made on first use."""

    def __init__(self, sim: CpuSimulator) -> None:
        self.sim = sim
        self._data: dict[str, mujoco.MjData] = {}
        model = sim.model(sim.layout.pack.homes[0].name)
        self._is_robot = (model.geom_contype & contact_bits.ROBOT) != 0
        self._geom_body = model.geom_bodyid.copy()
        self._tcp = sim.addresses.robot_body[TCP_LINK]
        joints = [model.joint(int(j)).name for j in model.actuator_trnid[:, 0]]
        self._fingers = [i for i, n in enumerate(joints) if n.endswith("gripper_finger_joint")]

    def _world(self, home: str, qpos: np.ndarray) -> tuple[mujoco.MjModel, mujoco.MjData]:
        model = self.sim.model(home)
        if home not in self._data:
            self._data[home] = mujoco.MjData(model)
        data = self._data[home]
        mujoco.mj_resetData(model, data)
        data.qpos[:] = qpos
        return model, data

    def tcp_pose(self, home: str, qpos: np.ndarray) -> np.ndarray:
        """(7,) world pose of the tool centre in the state ``qpos`` (nq,)."""
        model, data = self._world(home, qpos)
        mujoco.mj_kinematics(model, data)
        return self._read_tcp(data)

    def _read_tcp(self, data: mujoco.MjData) -> np.ndarray:
        return np.concatenate([data.xpos[self._tcp], data.xquat[self._tcp]])

    def collision_free(self, home: str, qpos: np.ndarray, carried: int = -1) -> bool:
        """Whether the robot touches nothing but object slot ``carried``, now and after one simulated control step."""
        model, data = self._world(home, qpos)
        mujoco.mj_forward(model, data)
        if self._collides(data, carried):
            return False
        hold_robot(model, data, self.sim.addresses)
        if carried >= 0:
            data.ctrl[self._fingers] = CLOSED_FINGER
        mujoco.mj_step(model, data, SUBSTEPS)
        return not self._collides(data, carried)

    def _collides(self, data: mujoco.MjData, carried: int) -> bool:
        pairs = data.contact.geom[: data.ncon]
        if not len(pairs):
            return False
        robot = self._is_robot[pairs]
        load = self.sim.addresses.object_body[carried] if carried >= 0 else -1
        ours = robot | (self._geom_body[pairs] == load)
        # A contact counts when one side is robot or load and the other is neither, or when the robot hits itself.
        return bool((ours.any(axis=1) & ~ours.all(axis=1)).any() or robot.all(axis=1).any())

    def try_grasp(
        self, slot: int, tcp_in_object: np.ndarray, width: float, seconds: float, min_force: float, max_angle: float
    ) -> tuple[np.ndarray, float] | None:
        """Close the gripper on an object in an empty corner, the robot at rest.

        Args:
            slot: the object.
            tcp_in_object: (7,) grasp pose in the frame of the object.
            width: distance between the pads at contact [m].
            seconds: how long the grasp test must hold, at every control step, after closing.
            min_force, max_angle: the test: force of each finger [N], its angle to the opening direction [rad].

        Returns:
            Object pose (7,) in the frame of the tool centre and finger position [m] at the end; None if it fails.
        """
        home, a = self.sim.layout.pack.homes[0].name, self.sim.addresses
        qpos = self.sim.model(home).qpos0.copy()
        robot = parked_robot_qpos()
        robot[FINGER_JOINTS] = min(0.5 * width + 0.001, FINGER_MAX)
        qpos[a.robot_q] = robot
        start = a.object_q[slot]
        qpos[start : start + 7] = pose_mul(self.tcp_pose(home, qpos), pose_inv(tcp_in_object))
        model, data = self._world(home, qpos)
        hold_robot(model, data, a)
        data.ctrl[self._fingers] = CLOSED_FINGER
        mujoco.mj_step(model, data, CLOSING_STEPS)
        for _ in range(round(seconds / (SUBSTEPS * model.opt.timestep))):
            mujoco.mj_step(model, data, SUBSTEPS)
            if not self._grasped(data, slot, min_force, max_angle):
                return None
        mujoco.mj_kinematics(model, data)
        relative = pose_mul(pose_inv(self._read_tcp(data)), data.qpos[start : start + 7])
        return relative, float(data.qpos[a.robot_q[FINGER_JOINTS.start]])

    def _grasped(self, data: mujoco.MjData, slot: int, min_force: float, max_angle: float) -> bool:
        a = self.sim.addresses
        for side, finger in enumerate(FINGER_LINKS):
            adr = a.finger_force[side, slot]
            force = -data.sensordata[adr : adr + 3]
            size = np.linalg.norm(force)
            opening = data.xmat[a.robot_body[finger]].reshape(3, 3) @ np.array(FINGER_OPEN_DIR[finger])
            if size < min_force or force @ opening < np.cos(max_angle) * size:
                return False
        return True
