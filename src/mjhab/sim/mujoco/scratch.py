"""Collision tests and grasp tests in private worlds, which leave the worlds of the simulator's batch unchanged.

Everything but the robot and the object it carries sleeps, which makes a test ten times as fast as a control step of a
home in which everything is awake.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import numpy as np

from mjhab.core.joints import BASE_YAW
from mjhab.core.memory_cache import MemoryCache
from mjhab.core.rotations import pose_inv, pose_mul
from mjhab.core.timing import SUBSTEPS
from mjhab.layout.contact_sensors import (
    FORCE_SENSOR_WIDTH,
    TOUCH_SENSOR_WIDTH,
    pair_force,
)
from mjhab.layout.home_models import model_bytes
from mjhab.robots.model import apply_drives
from mjhab.robots.parts import Drives
from mjhab.scenes import contact_bits
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import hold_robot

CLOSING_STEPS = 30
"""Substeps in which the fingers close before a grasp is tested."""
MOST_CREEP_M_S = 0.001
"""Largest mean speed [m/s] at which an object may slip in a hand at rest; a faster one is lost within seconds."""
TURN_RATE = 1.6
"""Yaw rate [rad/s] of the base in the turn test, half of its top speed."""
TURN_STEPS = 20
"""Substeps that the base turns to each side in the turn test."""
TURN_SLIP = 0.02
"""Largest slip [m] of a held object in the turn test. Some grasps near an edge hold still for minutes but lose the
object at the first turn of the base."""
MAX_MODELS = 32
"""Models that a private world caches, one per home; each takes 0.4 MB."""
_NO_CONTACT = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)


class _World:
    """A private world that can switch between the homes of a layout. Only one thread may use it at a time."""

    def __init__(self, sim: CpuSimulator) -> None:
        self._sim = sim
        # Models of a layout have the same sizes: one MjData serves them all.
        self.data = mujoco.MjData(sim.model(sim.layout.pack.homes[0].name))
        self._models = MemoryCache("models", MAX_MODELS, model_bytes)

    def arrange(
        self, home: str, qpos: np.ndarray, carried: int = -1, *, plain: bool = False
    ) -> mujoco.MjModel:
        """Reset the world to ``qpos`` (nq,) with zero velocity.

        All trees sleep but the robot, links that are not at their zero, and the carried object.

        Args:
            home: name of the home.
            qpos: (nq,) state.
            carried: object slot that stays awake, -1 for none.
            plain: use the servos that the robot was compiled with instead of those of the simulator.

        Returns:
            The model to simulate the world with.
        """
        model = self._models.get((home, plain), lambda: self._make(home, plain))
        a = self._sim.addresses
        # After a reset, trees with sleep policy INIT sleep at qpos0; a tree whose qpos differs from it wakes up.
        rows = (np.delete(a.object_q, carried) if carried >= 0 else a.object_q).astype(
            int
        )
        columns = rows[:, None] + np.arange(7)
        model.qpos0[columns] = qpos[columns]
        if carried >= 0:
            own = slice(int(a.object_q[carried]), int(a.object_q[carried]) + 7)
            # The model is kept and may have been changed by an earlier test.
            model.qpos0[own] = self._sim.model(home).qpos0[own]
        model.opt.disableflags |= _NO_CONTACT
        mujoco.mj_resetData(model, self.data)
        model.opt.disableflags &= ~_NO_CONTACT
        self.data.qpos[:] = qpos
        return model

    def _make(self, home: str, plain: bool) -> mujoco.MjModel:
        # A copy: the simulator's worlds share that of the home.
        model = copy.copy(self._sim.model(home))
        if plain:
            # Grasps are tested with the servos of the robot, whatever control mode the environment has.
            apply_drives(model, self._sim.layout.robot, Drives())
        a = self._sim.addresses
        trees = model.body_treeid[
            np.concatenate([a.object_body, a.link_body]).astype(int)
        ]
        model.tree_sleep_policy[trees] = int(mujoco.mjtSleepPolicy.mjSLEEP_INIT)
        return model


class Scratch:
    """Collision and grasp tests of states in the homes of a simulator.

    Several threads may run tests at the same time: each test uses a private world.

    Args:
        sim: gives layout and compiled models; its batch is not touched.
    """

    def __init__(self, sim: CpuSimulator) -> None:
        self.sim = sim
        self._idle: list[_World] = []
        model = sim.model(sim.layout.pack.homes[0].name)
        self._is_robot = (model.geom_contype & contact_bits.ROBOT) != 0
        self._geom_body = model.geom_bodyid.copy()
        robot = sim.layout.robot
        self._robot = robot
        self._tcp = sim.addresses.robot_body[robot.tcp]
        # Actuators have the order of the joints.
        self._fingers = list(robot.finger_columns)
        self._closed = robot.limits.gripper[0]

    @contextmanager
    def _world(self) -> Iterator[_World]:
        try:
            # Popping from a list is atomic, so that threads need no lock.
            world = self._idle.pop()
        except IndexError:
            world = _World(self.sim)
        try:
            yield world
        finally:
            # Back also after an error: the next test resets it anyway.
            self._idle.append(world)

    def tcp_pose(self, home: str, qpos: np.ndarray) -> np.ndarray:
        """Return the world pose (7,) [m, wxyz] of the tcp in the state ``qpos`` (nq,)."""
        with self._world() as world:
            model = world.arrange(home, qpos)
            mujoco.mj_kinematics(model, world.data)
            return self._read_tcp(world.data)

    def _read_tcp(self, data: mujoco.MjData) -> np.ndarray:
        return np.concatenate([data.xpos[self._tcp], data.xquat[self._tcp]])

    def collision_free(
        self,
        home: str,
        qpos: np.ndarray,
        carried: int = -1,
        grip: tuple[float, float] | None = None,
    ) -> bool:
        """Test whether robot and carried object touch nothing else, both now and after one control step.

        Args:
            home: name of the home.
            qpos: (nq,) state.
            carried: object slot in the gripper, -1 for none.
            grip: (least force of each finger [N], largest angle to the opening direction [rad]): if given, the object
                must also pass this grasp test after the control step.
        """
        with self._world() as world:
            model = world.arrange(home, qpos, carried)
            data = world.data
            # Positions and contacts alone: velocities and forces play no part in a collision.
            mujoco.mj_fwdPosition(model, data)
            if self._collides(data, carried):
                return False
            hold_robot(model, data)
            if carried >= 0:
                # Holding their position, the fingers would not press and the object would slip.
                data.ctrl[self._fingers] = self._closed
            mujoco.mj_step(model, data, SUBSTEPS)
            if self._collides(data, carried):
                return False
            return grip is None or self._grasped(data, carried, *grip)

    def _collides(self, data: mujoco.MjData, carried: int) -> bool:
        pairs = data.contact.geom[: data.ncon]
        if not len(pairs):
            return False
        robot = self._is_robot[pairs]
        load = self.sim.addresses.object_body[carried] if carried >= 0 else -1
        ours = robot | (self._geom_body[pairs] == load)
        # A contact counts if exactly one side is robot or carried object, or if both sides are the robot.
        return bool(
            (ours.any(axis=1) & ~ours.all(axis=1)).any() or robot.all(axis=1).any()
        )

    def holding(
        self, slot: int, robot: np.ndarray, tcp_in_object: np.ndarray
    ) -> np.ndarray:
        """Return the state (nq,) of the layout's first home with an object placed in the gripper.

        Args:
            slot: slot of the object.
            robot: (J,) joint positions [m, rad].
            tcp_in_object: (7,) pose of the tcp in the frame of the object [m, wxyz].
        """
        # The home does not matter: the test happens away from its furniture.
        home = self.sim.layout.pack.homes[0].name
        a = self.sim.addresses
        qpos = self.sim.model(home).qpos0.copy()
        qpos[a.robot_q] = robot
        start = a.object_q[slot]
        qpos[start : start + 7] = pose_mul(
            self.tcp_pose(home, qpos), pose_inv(tcp_in_object)
        )
        return qpos

    def try_grasp(
        self,
        slot: int,
        tcp_in_object: np.ndarray,
        robot: np.ndarray,
        seconds: float,
        min_force: float,
        max_angle: float,
    ) -> tuple[np.ndarray, float] | None:
        """Simulate a grasp: close the gripper on an object away from the home, hold it still, then turn the base.

        Args:
            slot: slot of the object.
            tcp_in_object: (7,) pose of the tcp in the frame of the object [m, wxyz].
            robot: (J,) joint positions [m, rad]: fingers just wider open than the object, base outside of the home.
            seconds: time [s] after closing in which the grasp test must hold at every control step.
            min_force: grasp test: least force of each finger [N].
            max_angle: grasp test: largest angle of that force to the finger's opening direction [rad].

        Returns:
            Object pose (7,) in the tcp frame and finger position [m] at the end of the hold; None if the object fails
            the grasp test or slips.
        """
        home = self.sim.layout.pack.homes[0].name
        a = self.sim.addresses
        qpos = self.holding(slot, robot, tcp_in_object)
        start = a.object_q[slot]
        with self._world() as world:
            model = world.arrange(home, qpos, slot, plain=True)
            data = world.data
            hold_robot(model, data)
            data.ctrl[self._fingers] = self._closed
            # Before the slip is measured: the object moves while the fingers close.
            mujoco.mj_step(model, data, CLOSING_STEPS)
            closed = self._load_pose(model, data, start)
            for _ in range(round(seconds / (SUBSTEPS * model.opt.timestep))):
                mujoco.mj_step(model, data, SUBSTEPS)
                if not self._grasped(data, slot, min_force, max_angle):
                    return None
            fingers = float(data.qpos[a.robot_q[self._fingers[0]]])
            relative = self._load_pose(model, data, start)
            if np.linalg.norm(relative[:3] - closed[:3]) > MOST_CREEP_M_S * seconds:
                return None
            # To both sides, so that the base ends where it began and both edges are tried.
            for rate in (TURN_RATE, -TURN_RATE):
                data.ctrl[BASE_YAW] = rate
                mujoco.mj_step(model, data, TURN_STEPS)
                if (
                    np.linalg.norm(self._load_pose(model, data, start)[:3] - relative[:3])
                    > TURN_SLIP
                ):
                    return None
            return relative, fingers

    def _load_pose(
        self, model: mujoco.MjModel, data: mujoco.MjData, start: int
    ) -> np.ndarray:
        """Return the pose (7,) in the tcp frame of the object whose qpos begins at column ``start``."""
        # After a step the poses are those of before its integration.
        mujoco.mj_kinematics(model, data)
        return pose_mul(pose_inv(self._read_tcp(data)), data.qpos[start : start + 7])

    def _grasped(
        self, data: mujoco.MjData, slot: int, min_force: float, max_angle: float
    ) -> bool:
        a = self.sim.addresses
        touch = a.touch[slot]
        touches = data.sensordata[touch : touch + TOUCH_SENSOR_WIDTH]
        for side, finger in enumerate(self._robot.fingers):
            listed = a.hand_force[side]
            readings = data.sensordata[listed : listed + FORCE_SENSOR_WIDTH]
            # The sensor gives the force of the finger on the object.
            force = -pair_force(readings, touches)[0]
            size = np.linalg.norm(force)
            opening = data.xmat[a.robot_body[finger.link]].reshape(3, 3) @ np.array(
                finger.opens
            )
            # Multiplied and not divided, for a finger without force.
            if size < min_force or force @ opening < np.cos(max_angle) * size:
                return False
        return True
