"""Action spaces of served policies: the columns that they send, and their places in the environment's actions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjhab.core.errors import unknown_name, wrong_value
from mjhab.robots.controllers import DEFAULT_MODE, ActionEntry

GRIPPER = "gripper"
ARM = "arm"
ARM_SPEEDS = "arm speeds"
"""Placeholders for the positions, or the speeds, of all joints of the robot's arm."""
BASE = ("base_forward", "base_yaw")


@dataclass(frozen=True)
class ActionSpace:
    """Format of the actions that a policy sends.

    control_mode: of the environment. columns: names of the sent columns, in order; empty for all columns of the
    environment's actions. Columns that are not sent are 0, so head, torso and perhaps the base do not move.
    closes: the gripper's column is 0 for open and 1 for closed as in DROID, instead of +1 and -1.
    """

    control_mode: str = DEFAULT_MODE
    columns: tuple[str, ...] = ()
    closes: bool = False


ACTION_SPACES: dict[str, ActionSpace] = {
    "joint": ActionSpace(),
    "ee": ActionSpace(
        "pd_ee_delta_pose",
        ("ee_x", "ee_y", "ee_z", "ee_rx", "ee_ry", "ee_rz", GRIPPER, *BASE),
    ),
    "joint_position": ActionSpace("pd_joint_pos", (ARM, GRIPPER), closes=True),
    "joint_velocity": ActionSpace("pd_joint_vel", (ARM_SPEEDS, GRIPPER), closes=True),
}
"""Action spaces by name. joint: joint deltas and base speeds. ee: end effector delta, gripper and base speeds.
joint_position, joint_velocity: arm and gripper, as in RoboArena."""
DEFAULT_SPACE = "joint"
ROUNDING = 1e-4
"""Part of its range by which a value may be out of it without being called so."""


def space_named(name: str) -> ActionSpace:
    """Return an action space by name.

    Raises:
        UsageError: the name is unknown.
    """
    if name not in ACTION_SPACES:
        raise unknown_name("action space", name, ACTION_SPACES)
    return ACTION_SPACES[name]


class ActionReader:
    """Converts a policy's actions to actions of an environment. ``gripper``: index of its entry in the latter.

    Args:
        name: of the action space.
        table: the environment's action table.

    Raises:
        UsageError: the environment's control mode does not fit the action space.
    """

    def __init__(self, name: str, table: Sequence[ActionEntry]) -> None:
        self._space = space_named(name)
        names = [entry.name for entry in table]
        self._width = len(names)
        self.gripper = names.index(GRIPPER)
        wanted = _columns(self._space, table) or tuple(names)
        lacking = [column for column in wanted if column not in names]
        if lacking:
            raise wrong_value(
                "control mode",
                ", ".join(names[:3]) + ", ...",
                self._space.control_mode,
                f"The actions of this environment have no {', '.join(lacking)}.",
                f"action space {name!r}",
            )
        self.names = wanted
        self._columns = [names.index(column) for column in wanted]
        entries = [table[column] for column in self._columns]
        self._units = ["" if entry.normalized else f" {entry.unit}" for entry in entries]
        bounds = [
            (-1.0, 1.0) if entry.normalized else (entry.low, entry.high)
            for entry in entries
        ]
        if self._space.closes:
            # RoboArena's grippers count from open to closed.
            bounds[wanted.index(GRIPPER)] = (0.0, 1.0)
        self._low, self._high = np.array(bounds, np.float64).T

    def problem(self, chunk: np.ndarray) -> str:
        """Describe what is wrong with a policy's actions (H, A); "" if they are valid."""
        if chunk.shape[1] != len(self.names):
            return f"actions have {chunk.shape[1]} numbers, not {len(self.names)}: {', '.join(self.names)}"
        bad = np.argwhere(~np.isfinite(chunk))
        if len(bad):
            step, column = (int(k) for k in bad[0])
            return f"action {step} of the chunk has {chunk[step, column]} for {self.names[column]}"
        return ""

    def outside(self, chunk: np.ndarray) -> np.ndarray:
        """Which values of valid actions (H, A) the environment clips (H, A) bool, but for rounding."""
        slack = ROUNDING * (self._high - self._low)
        return (chunk < self._low - slack) | (chunk > self._high + slack)

    def excess(self, chunk: np.ndarray) -> str:
        """Describe the value of valid actions (H, A) that is farthest out of its range, one of those of `outside`."""
        beyond = np.maximum(self._low - chunk, chunk - self._high)
        farthest = np.argmax(beyond / (self._high - self._low))
        step, column = (int(k) for k in np.unravel_index(farthest, chunk.shape))
        return (
            f"{chunk[step, column]:.4g}{self._units[column]} for {self.names[column]}, which goes from "
            f"{self._low[column]:.4g} to {self._high[column]:.4g}"
        )

    def read(self, chunk: np.ndarray) -> np.ndarray:
        """Convert valid actions (H, A) of a policy to environment actions (H, width) float32."""
        # Entries that the policy does not send stand still at 0.
        actions = np.zeros((len(chunk), self._width), np.float32)
        actions[:, self._columns] = chunk
        if self._space.closes:
            # Ours count from -1 closed to 1 open.
            actions[:, self.gripper] = 1.0 - 2.0 * actions[:, self.gripper]
        return actions


def _columns(space: ActionSpace, table: Sequence[ActionEntry]) -> tuple[str, ...]:
    """Column names of a space, with its placeholders replaced by the arm joints, which the table starts with."""
    names = [entry.name for entry in table]
    arm = list(dict.fromkeys(entry.joint for entry in table[: names.index(GRIPPER)]))
    found: list[str] = []
    for column in space.columns:
        if column == ARM:
            found += arm
        elif column == ARM_SPEEDS:
            found += [f"{joint}_speed" for joint in arm]
        else:
            found.append(column)
    return tuple(found)
