"""Starts with an object in the gripper, found by physics and not by a policy.

Grasp candidates from the object's geometry are tried in an empty corner of the world: the gripper at rest, the object
between the fingers, closing; those that still pass the grasp test after half a second are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from mjhab.core.errors import MjhabError
from mjhab.core.rotations import pose_inv, pose_mul
from mjhab.envs.grasps import ObjectShape, grasp_candidates
from mjhab.envs.spawns import CLOSED_FINGER
from mjhab.scenes.fetch import FINGER_LINKS, FINGER_OPEN_DIR
from mjhab.scenes.spec import ObjectType
from mjhab.sim.cpu import CpuSimulator
from mjhab.sim.settle import hold_robot, parked_robot_qpos

HOLD_SECONDS = 0.5
MIN_FORCE = 0.5
"""Finger force [N] of the grasp test (mani_skill/agents/robots/fetch/fetch.py)."""
MAX_ANGLE = np.deg2rad(30.0)
MAX_GRASPS = 6


def shape_of(kind: ObjectType) -> ObjectShape:
    """What a gripper sees of an object type: a box, can, ball or bowl of its size."""
    if len(kind.collision) > 1:
        return ObjectShape("bowl", kind.half)
    shape = next(iter(kind.collision)).shape
    return ObjectShape(shape if shape in ("box", "cylinder") else "sphere", kind.half)


@dataclass(frozen=True, eq=False)
class HeldGrasp:
    """A stable grasp: object pose (7,) in the frame of gripper_link, finger position [m]."""

    pose: np.ndarray
    fingers: float


class HeldStarts:
    """Stable grasps per object type, found once and remembered."""

    def __init__(self, sim: CpuSimulator) -> None:
        self.sim = sim
        self._found: dict[str, list[HeldGrasp]] = {}

    def grasps(self, kind: str) -> list[HeldGrasp]:
        """Stable grasps of an object type, best first.

        Raises:
            MjhabError: no candidate holds.
        """
        if kind not in self._found:
            slot = self.sim.layout.roster.index(kind)
            found: list[HeldGrasp] = []
            half_z = self.sim.layout.pack.objects[kind].half[2]
            candidates = grasp_candidates(
                shape_of(self.sim.layout.pack.objects[kind]), np.zeros(3), np.array([1.0, 0, 0, 0]), support_z=-half_z
            )
            for pos, quat, width in zip(candidates.pos, candidates.quat, candidates.width, strict=True):
                grasp = self._try(slot, np.concatenate([pos, quat]), float(width))
                if grasp is not None:
                    found.append(grasp)
                if len(found) >= MAX_GRASPS:
                    break
            if not found:
                raise MjhabError(f"no grasp of {kind} holds for {HOLD_SECONDS} s")
            self._found[kind] = found
        return self._found[kind]

    def _try(self, slot: int, tcp_in_object: np.ndarray, width: float) -> HeldGrasp | None:
        sim, a = self.sim, self.sim.addresses
        model = sim.model(sim.layout.pack.homes[0].name)
        data = mujoco.MjData(model)
        robot = parked_robot_qpos()
        robot[13:15] = min(0.5 * width + 0.001, 0.05)
        data.qpos[a.robot_q] = robot
        mujoco.mj_kinematics(model, data)
        gripper = a.robot_body["gripper_link"]
        tcp = np.concatenate([data.xpos[gripper], data.xquat[gripper]])
        start = a.object_q[slot]
        data.qpos[start : start + 7] = pose_mul(tcp, pose_inv(tcp_in_object))
        hold_robot(model, data, a)
        data.ctrl[[i for i in range(model.nu) if "finger" in model.actuator(i).name]] = CLOSED_FINGER
        # The grasp test must hold at every control step of the half second that follows the closing.
        mujoco.mj_step(model, data, 30)
        for _ in range(int(HOLD_SECONDS / 0.05)):
            mujoco.mj_step(model, data, 5)
            if not self._grasped(data, slot):
                return None
        mujoco.mj_kinematics(model, data)
        tcp = np.concatenate([data.xpos[gripper], data.xquat[gripper]])
        return HeldGrasp(pose_mul(pose_inv(tcp), data.qpos[start : start + 7]), float(data.qpos[a.robot_q[13]]))

    def _grasped(self, data: mujoco.MjData, slot: int) -> bool:
        a = self.sim.addresses
        for side, finger in enumerate(FINGER_LINKS):
            adr = a.finger_force[side, slot]
            force = -data.sensordata[adr : adr + 3]
            size = np.linalg.norm(force)
            body = a.robot_body[finger]
            opening = data.xmat[body].reshape(3, 3) @ np.array(FINGER_OPEN_DIR[finger])
            if size < MIN_FORCE or force @ opening < np.cos(MAX_ANGLE) * size:
                return False
        return True
