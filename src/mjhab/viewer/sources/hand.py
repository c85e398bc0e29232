"""Driving by hand: keys and sticks become actions of base, arm and gripper."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.core.files.reading import parse_json
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.robots.controllers import DEFAULT_MODE, make_controller
from mjhab.robots.registry import robot_named
from mjhab.robots.robot import Robot

HUMAN = "human"
"""Name of the actor, and of the policy whose episodes are driven by hand from their start."""
HAND_MODE = "pd_ee_target_delta_pose"
"""The control mode that turns motion of the gripper into motion of the arm's joints."""
SILENCE_SECONDS = 0.3
"""Without news from the page for so long, nothing counts as held: its tab was closed, or its network is gone."""
DEAD_ZONE = 0.12
"""Sticks of a gamepad that are deflected less count as released."""

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
"""Key (its place on the keyboard, as browsers name it) to motion and direction."""
GRIPPER_KEY = "Space"
"""Opens and closes the gripper in turn."""
STICKS: tuple[tuple[int, str, float], ...] = (
    (1, "forward", -1.0),
    (0, "turn", -1.0),
    (3, "x", -1.0),
    (2, "y", -1.0),
)
"""Axis of a standard gamepad, motion, direction."""
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
MOTIONS = ("forward", "turn", "x", "y", "z", "roll", "pitch", "yaw", "torso", "pan", "tilt")
_HAND_MOTIONS = ("x", "y", "z", "roll", "pitch", "yaw")
_BODY_MOTIONS = {"head": ("pan", "tilt"), "torso": ("torso",)}
"""Group of joints to the motions that set them, in the order of actions."""
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
"""Share of the largest action that a key, or a stick at its end, gives: 0.6 m/s forward, 0.26 m/s of the gripper."""


@dataclass(frozen=True)
class HandInput:
    """What is held. motions: -1 to 1 by name of MOTIONS; missing ones are 0. gripper: its key is held."""

    motions: Mapping[str, float] = field(default_factory=dict)
    gripper: bool = False


def read_input(message: str) -> HandInput:
    """What a message of `hand.js` says; keys and buttons without a meaning are passed over.

    Raises:
        ValueError: it is not such a message.
    """
    told = parse_json(message)
    if not isinstance(told, dict):
        raise ValueError(f"a message of the hand is an object, got {type(told).__name__}")
    keys, axes, buttons = (told.get(name, []) for name in ("keys", "axes", "buttons"))
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
        sums[motion] += direction * (float(buttons[button]) if button < len(buttons) else 0.0)
    pressed = len(buttons) > GRIPPER_BUTTON and float(buttons[GRIPPER_BUTTON]) > 0.5
    if not np.isfinite(list(sums.values())).all():
        raise ValueError("axes and buttons of the hand are finite numbers")
    motions = {name: float(np.clip(value, -1.0, 1.0)) for name, value in sums.items() if value}
    return HandInput(motions, GRIPPER_KEY in keys or pressed)


class HandControl:
    """Turns what is held into actions of the control mode of MS-HAB.

    The gripper moves along and about the axes of the torso, from where it was told to be: it does not sag, and an
    object that it holds stays where it is.

    Args:
        clock: seconds, for tests.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.gripper = 1.0
        self._clock = clock
        self._input = HandInput()
        self._heard = -np.inf
        self._was_pressed = False
        self._take_robot(robot_named())

    def hear(self, message: str) -> None:
        """Take a message of the page; one that cannot be understood counts as nothing held."""
        try:
            now = read_input(message)
        except (ValueError, TypeError):
            now = HandInput()
        if now.gripper and not self._was_pressed:
            self.gripper = -self.gripper
        self._was_pressed = now.gripper
        self._input = now
        self._heard = self._clock()

    def let_go(self) -> None:
        """Nothing is held any more."""
        self._input = HandInput()

    def begin(self, env: SequentialTaskEnv, world: int) -> None:
        """Take over a world: the arm stays where it is, and so do the fingers.

        Raises:
            UsageError: the environment takes other actions.
        """
        mode = env.config.control_mode
        if mode != DEFAULT_MODE:
            raise UsageError(
                f"by hand needs control_mode {DEFAULT_MODE!r}; this environment has {mode!r}."
            )
        self._take_robot(env.layout.robot)
        state = _Joints(env.state.robot_q[[world]])
        self._arm.reset(np.ones(1, bool), state)
        self.gripper = 1.0 if env.grip[world] >= 0.0 else -1.0

    def action(self, env: SequentialTaskEnv, world: int) -> np.ndarray:
        """The action (A,) float32 for the present state of a world."""
        held = self._input if self._clock() - self._heard < SILENCE_SECONDS else HandInput()
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
        """Commanded joint positions (J,) that move the gripper as wished; only those of the arm count."""
        given = np.zeros((1, self._arm.dim), np.float32)
        given[0, : len(_HAND_MOTIONS)] = [wish[name] for name in _HAND_MOTIONS]
        return self._arm.ctrl(given, _Joints(q))[0]


def _motions(robot: Robot) -> dict[str, str]:
    """Name of an entry of the action table to the motion that sets it, for base, torso and head."""
    found = {"base_forward": "forward", "base_yaw": "turn"}
    for group, motions in _BODY_MOTIONS.items():
        # A group may have fewer joints than there are motions, or more, which then stand still.
        found |= dict(zip(robot.group(group), motions, strict=False))
    return found


@dataclass(frozen=True)
class _Joints:
    """What a controller reads of a state: (1, J) joint positions."""

    robot_q: np.ndarray
