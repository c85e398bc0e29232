"""Teleoperation: keys, gamepad sticks and a pose to go to become actions of base, arm, gripper, torso and head."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from mjhab.core.errors import wrong_value
from mjhab.core.rotations import (
    mat_from_quat,
    pose_inv,
    pose_mul,
    quat_from_mat,
    rotation_vector,
    wrap,
)
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.robots.controllers import DEFAULT_MODE, make_controller
from mjhab.robots.registry import robot_named
from mjhab.robots.robot import Robot
from mjhab.viewer.sources.hand_input import MOTIONS, HandInput, read_input

HAND_MODE = "pd_ee_target_delta_pose"
"""Control mode of the controller that converts motion of the end effector into targets of the arm's joints."""
SILENCE_SECONDS = 0.3
"""After this time without a message from the page [s], all keys count as released: its tab or connection is closed."""
AIM_STEP_M = 0.02
AIM_STEP_RAD = 0.07
"""Farthest that the gripper moves and turns towards a pose in a control step: 0.4 m/s and 1.4 rad/s."""
_TARGET = "arm_target"
"""Key of the commanded joint positions in the state of the arm's controller."""
_HAND_MOTIONS = ("x", "y", "z", "roll", "pitch", "yaw")
_BODY_MOTIONS = {"head": ("pan", "tilt"), "torso": ("torso",)}
"""Motions that set the joints of a group, in the order of the group's joints."""
SHARES: dict[str, float] = {
    "forward": 0.6,
    "turn": 0.35,
    "x": 0.13,
    "y": 0.13,
    "z": 0.13,
    "roll": 0.35,
    "pitch": 0.35,
    "yaw": 0.35,
    "torso": 0.2,
    "pan": 0.5,
    "tilt": 0.5,
}
"""Fraction of the largest action that a key, or a fully deflected stick, commands: 0.6 m/s forward, 0.26 m/s of the
gripper."""


class HandControl:
    """Convert a person's wishes into actions of the control mode of MS-HAB, which policies learn in.

    The gripper moves along and about the axes of the torso, or to a pose that goes along with the torso (`aim`); either
    way from its commanded rather than its measured pose, so that it does not sag under load. Inverse kinematics makes
    positions of the joints of it in every control step, and the action is what leads to these: what is executed and
    recorded needs no conversion. No joint is commanded farther than an action reaches.

    Args:
        clock: returns monotonic time [s]; replaced in tests.

    Attributes:
        gripper: commanded action of the gripper, 1 open or -1 closed.
        holds: whether the key is held that lets the person act (`hand_input.HOLD_KEY`).
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.gripper = 1.0
        self.holds = False
        self._clock = clock
        self._input = HandInput()
        self._heard = -np.inf
        self._was_pressed = False
        self._aim: np.ndarray | None = None
        self._take_robot(robot_named())

    def hear(self, message: str) -> None:
        """Take a message of `hand.js`; an invalid one counts as all keys released."""
        try:
            now = read_input(message)
        except (ValueError, TypeError, OverflowError):
            # A page of another version must not leave the robot driving.
            now = HandInput()
        self.take(now)

    def take(self, now: HandInput) -> None:
        """Take the state of keys and gamepad, which holds for `SILENCE_SECONDS`."""
        # On the press alone: the message repeats while the key is held.
        if now.gripper and not self._was_pressed:
            self.toggle_gripper()
        self._was_pressed = now.gripper
        self.holds = now.hold
        self._input = now
        self._heard = self._clock()

    def toggle_gripper(self) -> None:
        """Open the gripper if it is commanded to close, else close it."""
        self.gripper = -self.gripper

    def let_go(self) -> None:
        """Treat all keys as released, and stay where the gripper is commanded."""
        self._input = HandInput()
        self.holds = False
        self._aim = None

    def aim(self, pose: np.ndarray) -> None:
        """Let the gripper go to a pose until another one is told or a key moves it; poses out of reach are approached.

        Args:
            pose: (7,) of the tcp in the frame of `Robot.arm_root`: position [m], quaternion wxyz.

        Raises:
            UsageError: they are no seven finite numbers, or the quaternion is 0.
        """
        given = np.array(pose, float)
        length = np.linalg.norm(given[3:])
        if given.shape != (7,) or not np.isfinite(given).all() or length < 1e-6:
            raise wrong_value("pose", pose, "position and quaternion (7,), finite")
        given[3:] /= length
        self._aim = given

    @property
    def pose(self) -> np.ndarray:
        """Where the gripper goes or stays: pose (7,) of the tcp in the frame of `Robot.arm_root`."""
        aim = self._aim
        if aim is not None:
            return aim.copy()
        pos, rot = self._commanded()
        return np.concatenate([pos, quat_from_mat(rot)])

    def begin(self, env: SequentialTaskEnv, world: int) -> None:
        """Start to control a world, with the present joint positions and gripper command as targets.

        Raises:
            UsageError: the environment has another control mode than `DEFAULT_MODE`.
        """
        mode = env.config.control_mode
        if mode != DEFAULT_MODE:
            raise wrong_value("control_mode", mode, f"{DEFAULT_MODE!r} by hand")
        self._take_robot(env.layout.robot)
        state = _Joints(env.state.robot_q[[world]])
        self._arm.reset(np.ones(1, bool), state)
        self._aim = None
        self.gripper = 1.0 if env.grip[world] >= 0.0 else -1.0

    def action(self, env: SequentialTaskEnv, world: int) -> np.ndarray:
        """Compute the action (A,) float32, each entry in -1..1, for the present state of a world."""
        held = (
            self._input if self._clock() - self._heard < SILENCE_SECONDS else HandInput()
        )
        wish = {name: SHARES[name] * held.motions.get(name, 0.0) for name in MOTIONS}
        q = env.state.robot_q[[world]]
        move = self._hand_move(wish)
        target = self._towards_rest(q) if held.rest else self._arm_target(move, q)
        action = np.zeros(len(env.action_table), np.float32)
        gripper = env.controller.gripper
        for column, entry in enumerate(env.action_table):
            if column < gripper:
                (joint,) = self._robot.columns_of((entry.joint,))
                # The mode of policies takes differences from the measured joints.
                action[column] = (target[joint] - q[0, joint]) / entry.high
            elif column == gripper:
                action[column] = self.gripper
            elif entry.name in self._motions:
                action[column] = wish[self._motions[entry.name]]
        return np.clip(action, -1.0, 1.0)

    def _take_robot(self, robot: Robot) -> None:
        self._robot = robot
        self._arm = make_controller(HAND_MODE, 1, robot=robot)
        self._motions = _motions(robot)

    def _commanded(self) -> tuple[np.ndarray, np.ndarray]:
        """Commanded position (3,) [m] and rotation (3, 3) of the tcp in the frame of `Robot.arm_root`."""
        posture = self._arm.get_state(0)[_TARGET][None]
        pos, rot = self._robot.arm_chain.tip_pose(posture)
        return pos[0], rot[0]

    def _hand_move(self, wish: Mapping[str, float]) -> np.ndarray:
        """Entries (6,) of an action of `HAND_MODE` that move the gripper as keys say, or else towards `aim`."""
        move = np.array([wish[name] for name in _HAND_MOTIONS], np.float32)
        # A key is newer than the pose that was told before.
        if move.any():
            self._aim = None
        aim = self._aim
        if aim is None:
            return move
        pos, rot = self._commanded()
        way = _shortened(aim[:3] - pos, AIM_STEP_M)
        spin = mat_from_quat(aim[3:]) @ rot.T
        turn = _shortened(rotation_vector(spin[None])[0], AIM_STEP_RAD)
        limits = self._arm.limits
        return np.concatenate([way / limits.ee_move, turn / limits.ee_turn])

    def _towards_rest(self, q: np.ndarray) -> np.ndarray:
        """Target joint positions (J,) that bring the arm nearer to its posture at rest; ``q`` (1, J): measured."""
        arm = list(self._robot.arm_columns)
        limits = np.array([self._robot.joint_limits[column] for column in arm])
        way = self._robot.rest[arm] - q[0, arm]
        way = np.where(np.isfinite(limits[:, 0]), way, wrap(way))
        target = q[0].copy()
        # All joints in proportion, so that they arrive together.
        target[arm] += way / max(1.0, np.abs(way).max() / self._arm.limits.joint_delta)
        # The next key starts from here, not from where the arm was sent before.
        self._arm.set_state(0, {_TARGET: target[arm]})
        self._aim = None
        return target

    def _arm_target(self, move: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Target joint positions (J,) [rad or m] after a move of the gripper; only the arm's are used.

        ``move``: (6,), see `_hand_move`; ``q`` (1, J): measured joint positions.
        """
        given = np.zeros((1, self._arm.dim), np.float32)
        given[0, : len(move)] = move
        target = self._arm.ctrl(given, _Joints(q))[0]
        # What an action cannot reach in a step must not add up while the arm is blocked or slow.
        arm = list(self._robot.arm_columns)
        way = target[arm] - q[0, arm]
        share = np.abs(way).max() / self._arm.limits.joint_delta
        if share > 1.0:
            target[arm] = q[0, arm] + way / share
            self._arm.set_state(0, {_TARGET: target[arm]})
        return target


def tcp_in_arm_frame(robot: Robot, q: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Pose (7,) of the tcp for `HandControl.aim`, from one in the world and joint positions (J,) [m, rad]."""
    pos, rot = (each[0] for each in robot.chain.forward(q[None]).of(robot.arm_root))
    root = np.concatenate([pos, quat_from_mat(rot)])
    return pose_mul(pose_inv(root), pose)


def _shortened(vector: np.ndarray, most: float) -> np.ndarray:
    """The vector (3,), or one of length ``most`` in its direction if it is longer."""
    return vector * min(1.0, most / max(float(np.linalg.norm(vector)), 1e-12))


def _motions(robot: Robot) -> dict[str, str]:
    """Motion by name of the entry of the action table that it sets, for base, torso and head."""
    found = {"base_forward": "forward", "base_yaw": "turn"}
    for group, motions in _BODY_MOTIONS.items():
        # A group may have fewer joints than there are motions, or more, which then do not move.
        found |= dict(zip(robot.group(group), motions, strict=False))
    return found


@dataclass(frozen=True)
class _Joints:
    """The part of a state that a controller reads: joint positions (1, J)."""

    robot_q: np.ndarray
