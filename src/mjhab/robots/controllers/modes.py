"""Registry of control modes, which define the meaning of the arm's entries of an action. Plugins can add modes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mjhab.core.errors import wrong_type, wrong_value
from mjhab.core.names import check_name
from mjhab.core.registration.registry import Registry, check_item
from mjhab.robots.controllers.arm import ArmController, ArmRequest

DEFAULT_MODE = "pd_joint_delta_pos"
"""The control mode of MS-HAB, which all experts use."""
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
    "pd_ee_delta_pose_maniskill",
    "pd_ee_target_delta_pose_maniskill",
    "pd_ee_pose",
    "pd_joint_delta_pos_stiff_body",
)


@dataclass(frozen=True)
class ControlMode:
    """A control mode; `mjhab.register_control_mode` makes one available to environments and commands.

    The order of an action is arm, gripper, head, torso, base. Modes differ in the arm, some also in head and torso.

    Attributes:
        name: name in ``mjhab.make(control_mode=...)``.
        make_arm: returns the `ArmController` that turns the arm's entries of actions into servo commands.
        stiff_body: head and torso take absolute positions [rad, m] with stiff servos, instead of changes.

    Raises:
        UsageError: the name is not usable as a file name, or ``make_arm`` is not callable.
    """

    name: str
    make_arm: Callable[[ArmRequest], ArmController]
    stiff_body: bool = False

    def __post_init__(self) -> None:
        check_name("name of the control mode", self.name)
        if not callable(self.make_arm):
            raise wrong_value(
                "make_arm",
                self.make_arm,
                "a function or class that takes an ArmRequest and returns an Arm",
                where=f"control mode {self.name!r}",
            )

    def arm(self, request: ArmRequest) -> ArmController:
        """Make the arm controller for a request.

        Raises:
            UsageError: ``make_arm`` does not return an `ArmController`.
        """
        arm = self.make_arm(request)
        if not isinstance(arm, ArmController):
            raise wrong_type(
                "what make_arm returns",
                arm,
                "a mjhab.robots.controllers.arm.Arm",
                where=f"control mode {self.name!r}",
            )
        return arm


CONTROL_MODES: Registry[ControlMode] = Registry(
    "control mode",
    {
        name: f"mjhab.robots.controllers.builtin_modes:{name.upper()}"
        for name in _BUILTIN_MODES
    },
)
"""All control modes, the built-in ones first."""


def register_control_mode(mode: ControlMode) -> ControlMode:
    """Make a control mode known to ``mjhab.make(control_mode=NAME)`` and to all commands.

    Returns:
        ``mode``, so that the call can wrap its construction.

    Raises:
        UsageError: ``mode`` is not a `ControlMode`, or its name is taken; the message says by which module.
    """
    check_item("register_control_mode", mode, ControlMode)
    return CONTROL_MODES.add(mode.name, mode)
