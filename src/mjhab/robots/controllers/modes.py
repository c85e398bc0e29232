"""Control modes by name: what the numbers of an action mean for the arm, open to plugins."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mjhab.core.errors import UsageError
from mjhab.core.names import check_name
from mjhab.core.registration.registry import Registry, check_item
from mjhab.robots.controllers.arm import Arm, ArmRequest

DEFAULT_MODE = "pd_joint_delta_pos"
"""The mode of MS-HAB: every policy and expert speaks it."""
_BUILTIN_MODES = (
    DEFAULT_MODE,
    "pd_joint_target_delta_pos",
    "pd_joint_pos",
    "pd_joint_vel",
    "pd_joint_pos_vel",
    "pd_joint_delta_pos_vel",
    "pd_ee_delta_pos",
    "pd_ee_delta_pose",
    "pd_ee_delta_pose_align",
    "pd_ee_target_delta_pos",
    "pd_ee_target_delta_pose",
    "pd_ee_pose",
    "pd_joint_delta_pos_stiff_body",
)


@dataclass(frozen=True)
class ControlMode:
    """A control mode. Registering one (`mjhab.register_control_mode`) makes it known to all of mjhab.

    Every action is laid out arm, gripper, body (head, torso), base. Modes differ in the arm, some in the body.

    Attributes:
        name: what ``mjhab.make(control_mode=...)`` calls it.
        make_arm: makes the `Arm` that turns its share of an action into servo commands, for W worlds of a robot.
        stiff_body: head and torso are given positions [rad, m] for stiff servos, instead of changes.

    Raises:
        UsageError: the name is none that a file could have, or ``make_arm`` is nothing that can be called.
    """

    name: str
    make_arm: Callable[[ArmRequest], Arm]
    stiff_body: bool = False

    def __post_init__(self) -> None:
        try:
            check_name("name of the control mode", self.name)
        except ValueError as error:
            raise UsageError(str(error)) from error
        if not callable(self.make_arm):
            raise UsageError(
                f"control mode {self.name!r}: make_arm must be a function or class that takes an ArmRequest and "
                f"returns an Arm, got {self.make_arm!r}."
            )

    def arm(self, request: ArmRequest) -> Arm:
        """The arm controller for a request.

        Raises:
            UsageError: ``make_arm`` returns something that is no `Arm`.
        """
        arm = self.make_arm(request)
        if not isinstance(arm, Arm):
            raise UsageError(
                f"control mode {self.name!r}: make_arm must return a mjhab.robots.controllers.arm.Arm, got "
                f"{type(arm).__name__}."
            )
        return arm


CONTROL_MODES: Registry[ControlMode] = Registry(
    "control mode",
    {name: f"mjhab.robots.controllers.builtin_modes:{name.upper()}" for name in _BUILTIN_MODES},
)
"""All control modes, those of mjhab first."""


def register_control_mode(mode: ControlMode) -> ControlMode:
    """Make a control mode known to ``mjhab.make(control_mode=NAME)`` and to all commands.

    Returns:
        The mode, so that it can be registered where it is made.

    Raises:
        UsageError: it is no `ControlMode`, or its name is taken; the message says by whom.
    """
    check_item("register_control_mode", mode, ControlMode)
    return CONTROL_MODES.add(mode.name, mode)
