"""A control mode that mjhab does not have: joint positions that the arm approaches at a bounded speed.

An action of ``pd_joint_pos`` far from the present posture makes the servos pull with all their force. Here the servos
follow a target that moves towards the action by at most `ActionLimits.joint_delta` per control step:

    MJHAB_PLUGINS=examples/control_mode.py python -c "
    import mjhab
    env = mjhab.make(task='set_table', subtask='pick', control_mode='pd_joint_pos_smooth')
    print([row.name for row in env.controller.table])"
"""

from __future__ import annotations

from mjhab import ControlMode, register_control_mode
from mjhab.core.arrays import Array, between
from mjhab.robots.controllers.arm import ArmRequest, CommandedArm
from mjhab.robots.controllers.table import absolute_rows


class SmoothJointPosition(CommandedArm):
    """The action is a posture [rad]; ``target`` (W, A) is where the servos are on the way to it."""

    remembers = True

    def __init__(self, request: ArmRequest) -> None:
        robot = request.robot
        super().__init__(request, absolute_rows(robot, robot.group("arm")))
        self._step = request.limits.joint_delta

    def command(self, move: Array, q: Array) -> Array:
        """Servo commands (W, A) for the postures ``move`` (W, A)."""
        self.target = between(move, self.target - self._step, self.target + self._step)
        return self.target

    def still(self, q: Array) -> Array:
        """The posture that the arm has (W, A)."""
        return q


register_control_mode(ControlMode("pd_joint_pos_smooth", SmoothJointPosition))
