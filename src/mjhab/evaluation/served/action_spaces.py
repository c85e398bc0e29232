"""Action spaces of served policies: which numbers they send, and where these go in an action of the environment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjhab.core.errors import UsageError, unknown_name
from mjhab.robots.controllers import DEFAULT_MODE, ActionEntry

GRIPPER = "gripper"
ARM = "arm"
ARM_SPEEDS = "arm speeds"
"""Stand for the positions, or the speeds, of all joints of the arm of a robot."""
BASE = ("base_forward", "base_yaw")


@dataclass(frozen=True)
class ActionSpace:
    """What a policy sends.

    control_mode: of the environment. columns: names of its numbers in the order in which they are sent; empty for all
    numbers of the environment. Those that are not sent are 0: head, torso and perhaps the base stand still.
    closes: the gripper's number is 0 for open and 1 for closed as in DROID, not +1 and -1.
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
"""Changes of all joints and the base's speeds; end effector, gripper, base; the two of RoboArena: arm and gripper."""
DEFAULT_SPACE = "joint"


def space_named(name: str) -> ActionSpace:
    """An action space by its name.

    Raises:
        UsageError: there is none of this name.
    """
    if name not in ACTION_SPACES:
        raise unknown_name("action space", name, ACTION_SPACES)
    return ACTION_SPACES[name]


class ActionReader:
    """Turns what a policy sends into actions of an environment.

    Args:
        name: of the action space.
        table: the actions of the environment.

    Raises:
        UsageError: the environment has another control mode than the action space needs.
    """

    def __init__(self, name: str, table: Sequence[ActionEntry]) -> None:
        self._space = space_named(name)
        names = [entry.name for entry in table]
        self._width = len(names)
        wanted = _columns(self._space, table) or tuple(names)
        lacking = [column for column in wanted if column not in names]
        if lacking:
            raise UsageError(
                f"the action space {name!r} needs control mode {self._space.control_mode}: the actions of this "
                f"environment have no {', '.join(lacking)}."
            )
        self.names = wanted
        self._columns = [names.index(column) for column in wanted]

    def problem(self, chunk: np.ndarray) -> str:
        """What is wrong with actions (H, A) of a policy, in words; empty if nothing is."""
        if chunk.shape[1] != len(self.names):
            return f"actions have {chunk.shape[1]} numbers, not {len(self.names)}: {', '.join(self.names)}"
        bad = np.argwhere(~np.isfinite(chunk))
        if len(bad):
            step, column = (int(k) for k in bad[0])
            return f"action {step} of the chunk has {chunk[step, column]} for {self.names[column]}"
        return ""

    def read(self, chunk: np.ndarray) -> np.ndarray:
        """Actions (H, width of the environment) float32 of those that a policy sent, which have no `problem`."""
        actions = np.zeros((len(chunk), self._width), np.float32)
        actions[:, self._columns] = chunk
        if self._space.closes:
            gripper = self._columns[self.names.index(GRIPPER)]
            actions[:, gripper] = 1.0 - 2.0 * actions[:, gripper]
        return actions


def _columns(space: ActionSpace, table: Sequence[ActionEntry]) -> tuple[str, ...]:
    """Names of the numbers of a space, with the joints of the arm that the table begins with."""
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
