"""The built-in control modes, with the names of ManiSkill (mani_skill/agents/robots/fetch/fetch.py)."""

from __future__ import annotations

from functools import partial

from mjhab.robots.controllers.arm import (
    JointDelta,
    JointPosition,
    JointPositionVelocity,
    JointTargetDelta,
    JointVelocity,
)
from mjhab.robots.controllers.end_effector import EndEffector
from mjhab.robots.controllers.modes import ControlMode

PD_JOINT_DELTA_POS = ControlMode("pd_joint_delta_pos", JointDelta)
PD_JOINT_TARGET_DELTA_POS = ControlMode("pd_joint_target_delta_pos", JointTargetDelta)
PD_JOINT_POS = ControlMode("pd_joint_pos", JointPosition)
PD_JOINT_VEL = ControlMode("pd_joint_vel", JointVelocity)
PD_JOINT_POS_VEL = ControlMode(
    "pd_joint_pos_vel", partial(JointPositionVelocity, delta=False)
)
PD_JOINT_DELTA_POS_VEL = ControlMode(
    "pd_joint_delta_pos_vel", partial(JointPositionVelocity, delta=True)
)
PD_EE_DELTA_POS = ControlMode(
    "pd_ee_delta_pos", partial(EndEffector, start="measured", rotates=False)
)
PD_EE_DELTA_POSE = ControlMode("pd_ee_delta_pose", partial(EndEffector, start="measured"))
PD_EE_DELTA_POSE_ALIGN = ControlMode(
    "pd_ee_delta_pose_align", partial(EndEffector, start="measured", own_axes=True)
)
PD_EE_TARGET_DELTA_POS = ControlMode(
    "pd_ee_target_delta_pos", partial(EndEffector, start="target", rotates=False)
)
PD_EE_TARGET_DELTA_POSE = ControlMode(
    "pd_ee_target_delta_pose", partial(EndEffector, start="target")
)
PD_EE_DELTA_POSE_MANISKILL = ControlMode(
    "pd_ee_delta_pose_maniskill",
    partial(EndEffector, start="measured", as_maniskill=True),
)
PD_EE_TARGET_DELTA_POSE_MANISKILL = ControlMode(
    "pd_ee_target_delta_pose_maniskill",
    partial(EndEffector, start="target", as_maniskill=True),
)
PD_EE_POSE = ControlMode("pd_ee_pose", partial(EndEffector, start="absolute"))
PD_JOINT_DELTA_POS_STIFF_BODY = ControlMode(
    "pd_joint_delta_pos_stiff_body", JointDelta, stiff_body=True
)
