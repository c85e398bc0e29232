"""Messages of the page: which keys are held and how the sticks of a gamepad stand, as motions of the robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mjhab.core.files.reading import parse_json

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
HOLD_KEY = "KeyC"
"""Key that lets the person act as long as it is held, and the policy again when it is released."""
HOLD_BUTTONS = (10, 11)
"""Buttons that do the same: the sticks, pressed."""
REST_KEY = "KeyV"
"""Key that brings the arm to its posture at rest, as long as it is held: tasks end there, and a pose of the hand leaves
the elbow free."""
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


@dataclass(frozen=True)
class HandInput:
    """State of keys and gamepad. motions: -1 to 1 by name of `MOTIONS`, 0 if missing. gripper, hold, rest: their
    key is down."""

    motions: Mapping[str, float] = field(default_factory=dict)
    gripper: bool = False
    hold: bool = False
    rest: bool = False


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
        # Sticks do not come back to exactly 0.
        sums[motion] += direction * value * (abs(value) > DEAD_ZONE)
    for button, (motion, direction) in BUTTONS.items():
        sums[motion] += direction * (
            float(buttons[button]) if button < len(buttons) else 0.0
        )
    pressed = {button for button, value in enumerate(buttons) if float(value) > 0.5}
    if not np.isfinite(list(sums.values())).all():
        raise ValueError("axes and buttons of the hand are finite numbers")
    motions = {
        # A key and a stick together are no faster than one.
        name: float(np.clip(value, -1.0, 1.0))
        for name, value in sums.items()
        if value
    }
    return HandInput(
        motions,
        GRIPPER_KEY in keys or GRIPPER_BUTTON in pressed,
        HOLD_KEY in keys or not pressed.isdisjoint(HOLD_BUTTONS),
        REST_KEY in keys,
    )
