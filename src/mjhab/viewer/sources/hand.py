"""Teleoperation: keys and gamepad sticks become actions of base, arm, gripper, torso and head."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from mjhab.core.errors import wrong_value
from mjhab.core.files.reading import parse_json
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.robots.controllers import DEFAULT_MODE, make_controller
from mjhab.robots.registry import robot_named
from mjhab.robots.robot import Robot

HUMAN = "human"
"""Name of a teleoperating person as an actor, and of the policy whose episodes are teleoperated from their start."""
HAND_MODE = "pd_ee_target_delta_pose"
"""Control mode of the controller that converts motion of the end effector into targets of the arm's joints."""
SILENCE_SECONDS = 0.3
"""After this time without a message from the page [s], all keys count as released: its tab or connection is closed."""
DEAD_ZONE = 0.12
"""Deflection (0..1) of a gamepad stick up to which it counts as released."""

KEYS: dict[str, tuple[str, float]] = {
    "KeyW": ("forward", 1.0),
    "KeyS": ("forward", -1.0),
    "KeyA": ("turn", 1.0),
    "KeyD": ("turn", -1.0),
    "KeyI": ("x", 1.0),
    "KeyK": ("x", -1.0),
    "KeyJ": ("y", 1.0),
    "KeyL": ("y", -1.0),
    "KeyU": ("z", 1.0),
    "KeyO": ("z", -1.0),
    "KeyR": ("roll", 1.0),
    "KeyF": ("roll", -1.0),
    "KeyT": ("pitch", 1.0),
    "KeyG": ("pitch", -1.0),
    "KeyY": ("yaw", 1.0),
    "KeyH": ("yaw", -1.0),
    "KeyZ": ("torso", 1.0),
    "KeyX": ("torso", -1.0),
    "ArrowLeft": ("pan", 1.0),
    "ArrowRight": ("pan", -1.0),
    "ArrowDown": ("tilt", 1.0),
    "ArrowUp": ("tilt", -1.0),
}
"""Motion and direction by key (``KeyboardEvent.code`` of browsers)."""
GRIPPER_KEY = "Space"
"""Key that toggles the gripper between open and closed."""
STICKS: tuple[tuple[int, str, float], ...] = (
    (1, "forward", -1.0),
    (0, "turn", -1.0),
    (3, "x", -1.0),
    (2, "y", -1.0),
)
"""Axis index of the browsers' "standard" gamepad mapping, motion, direction."""
BUTTONS: dict[int, tuple[str, float]] = {
    6: ("z", -1.0),
    7: ("z", 1.0),
    4: ("yaw", 1.0),
    5: ("yaw", -1.0),
    12: ("pitch", -1.0),
    13: ("pitch", 1.0),
    14: ("roll", -1.0),
    15: ("roll", 1.0),
    3: ("torso", 1.0),
    2: ("torso", -1.0),
}
GRIPPER_BUTTON = 0
MOTIONS = (
    "forward",
    "turn",
    "x",
    "y",
    "z",
    "roll",
    "pitch",
    "yaw",
    "torso",
    "pan",
    "tilt",
)
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


@dataclass(frozen=True)
class HandInput:
    """State of keys and gamepad. motions: -1 to 1 by name of `MOTIONS`, 0 if missing. gripper: its key is down."""

    motions: Mapping[str, float] = field(default_factory=dict)
    gripper: bool = False


def read_input(message: str) -> HandInput:
    """Parse a message of `hand.js`; keys and buttons without a motion are ignored.

    Args:
        message: JSON object with the lists "keys" (codes), "axes" (-1..1) and "buttons" (0..1).

    Raises:
        ValueError: it is not such a message.
    """
    sent = parse_json(message)
    if not isinstance(sent, dict):
        raise ValueError(f"a message of the hand is an object, got {type(sent).__name__}")
    keys, axes, buttons = (sent.get(name, []) for name in ("keys", "axes", "buttons"))
    if not all(isinstance(part, list) for part in (keys, axes, buttons)):
        raise ValueError("keys, axes and buttons of the hand are lists")
    sums: dict[str, float] = {name: 0.0 for name in MOTIONS}
    for key in keys:
        if key in KEYS:
            motion, direction = KEYS[key]
            sums[motion] += direction
    for axis, motion, direction in STICKS:
        value = float(axes[axis]) if axis < len(axes) else 0.0
        sums[motion] += direction * value * (abs(value) > DEAD_ZONE)
    for button, (motion, direction) in BUTTONS.items():
        sums[motion] += direction * (
            float(buttons[button]) if button < len(buttons) else 0.0
        )
    pressed = len(buttons) > GRIPPER_BUTTON and float(buttons[GRIPPER_BUTTON]) > 0.5
    if not np.isfinite(list(sums.values())).all():
        raise ValueError("axes and buttons of the hand are finite numbers")
    motions = {
        name: float(np.clip(value, -1.0, 1.0)) for name, value in sums.items() if value
    }
    return HandInput(motions, GRIPPER_KEY in keys or pressed)


class HandControl:
    """Convert the state of keys and gamepad into actions of the control mode of MS-HAB.

    The gripper moves along and about the axes of the torso, relative to its commanded rather than its measured pose, so
    that it does not sag under load.

    Args:
        clock: returns monotonic time [s]; replaced in tests.

    Attributes:
        gripper: commanded action of the gripper, 1 open or -1 closed.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.gripper = 1.0
        self._clock = clock
        self._input = HandInput()
        self._heard = -np.inf
        self._was_pressed = False
        self._take_robot(robot_named())

    def hear(self, message: str) -> None:
        """Take a message of `hand.js`; an invalid one counts as all keys released."""
        try:
            now = read_input(message)
        except (ValueError, TypeError, OverflowError):
            now = HandInput()
        if now.gripper and not self._was_pressed:
            self.gripper = -self.gripper
        self._was_pressed = now.gripper
        self._input = now
        self._heard = self._clock()

    def let_go(self) -> None:
        """Treat all keys as released."""
        self._input = HandInput()

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
        self.gripper = 1.0 if env.grip[world] >= 0.0 else -1.0

    def action(self, env: SequentialTaskEnv, world: int) -> np.ndarray:
        """Compute the action (A,) float32, each entry in -1..1, for the present state of a world."""
        held = (
            self._input if self._clock() - self._heard < SILENCE_SECONDS else HandInput()
        )
        wish = {name: SHARES[name] * held.motions.get(name, 0.0) for name in MOTIONS}
        q = env.state.robot_q[[world]]
        target = self._arm_target(wish, q)
        action = np.zeros(len(env.action_table), np.float32)
        gripper = env.controller.gripper
        for column, entry in enumerate(env.action_table):
            if column < gripper:
                (joint,) = self._robot.columns_of((entry.joint,))
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

    def _arm_target(self, wish: Mapping[str, float], q: np.ndarray) -> np.ndarray:
        """Target joint positions (J,) [rad or m] that move the gripper as ``wish`` says; only the arm's are used.

        ``wish``: fraction of the largest action by motion; ``q`` (1, J): measured joint positions.
        """
        given = np.zeros((1, self._arm.dim), np.float32)
        given[0, : len(_HAND_MOTIONS)] = [wish[name] for name in _HAND_MOTIONS]
        return self._arm.ctrl(given, _Joints(q))[0]


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
