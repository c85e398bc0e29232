"""The Fetch robot: joints, limits, gains, cameras.

Numbers are those of ManiSkill's Fetch, which MS-HAB uses: ``mani_skill/assets/robots/fetch/fetch.urdf`` (tree,
limits) and ``mani_skill/agents/robots/fetch/fetch.py`` (gains, rest keyframe, cameras, grasp test). The base moves
in the plane by three joints, 2 cm above the floor, so that it can neither tip nor touch the floor.
Lengths [m], angles [rad], forces [N or N m]. In the frame of ``base_link``, +x is forward and +z up.
"""

from __future__ import annotations

import math

from mjhab.robots.fetch.geometry import COLLISION
from mjhab.robots.parts import LOOK_FORWARD, CameraMount, Finger, Gains, TreeLink

FETCH_JOINTS: tuple[str, ...] = (
    "root_x_axis_joint",
    "root_y_axis_joint",
    "root_z_rotation_joint",
    "torso_lift_joint",
    "head_pan_joint",
    "shoulder_pan_joint",
    "head_tilt_joint",
    "shoulder_lift_joint",
    "upperarm_roll_joint",
    "elbow_flex_joint",
    "forearm_roll_joint",
    "wrist_flex_joint",
    "wrist_roll_joint",
    "r_gripper_finger_joint",
    "l_gripper_finger_joint",
)
"""The 15 joints in the order of MS-HAB's qpos and qvel (breadth-first)."""

REST_QPOS: tuple[float, ...] = (
    0.0, 0.0, 0.0, 0.386, 0.0, -0.370, 0.562, -1.032, 0.695, 0.955, -0.1, 2.077, 0.0, 0.015, 0.015,
)  # fmt: skip
"""Joint positions [m, rad] of the rest keyframe, in the order of FETCH_JOINTS."""

BASE_HEIGHT = 0.02
"""Height of base_link above the floor [m]."""
_X = (1.0, 0.0, 0.0)
_Y = (0.0, 1.0, 0.0)
_Z = (0.0, 0.0, 1.0)

KINEMATIC_TREE: tuple[TreeLink, ...] = (
    TreeLink("r_wheel_link", "base_link", "", (0.0012914, -0.18738, 0.055325)),
    TreeLink("l_wheel_link", "base_link", "", (0.0012914, 0.18738, 0.055325)),
    TreeLink("estop_link", "base_link", "", (-0.12465, 0.23892, 0.31127), quat=(math.sqrt(0.5), math.sqrt(0.5), 0, 0)),
    TreeLink("laser_link", "base_link", "", (0.235, 0.0, 0.2878), quat=(0.0, 1.0, 0.0, 0.0)),
    TreeLink("torso_fixed_link", "base_link", "", (-0.086875, 0.0, 0.377425)),
    TreeLink("torso_lift_link", "base_link", "torso_lift_joint", (-0.086875, 0.0, 0.37743), _Z, True, (0.0, 0.38615)),
    TreeLink("bellows_link", "torso_lift_link", "", (0.0, 0.0, 0.0)),
    TreeLink("bellows_link2", "torso_lift_link", "", (0.0, 0.0, 0.0)),
    TreeLink(
        "head_pan_link", "torso_lift_link", "head_pan_joint", (0.053125, 0.0, 0.603001417713939), _Z,
        limits=(-1.57, 1.57),
    ),
    TreeLink(
        "head_tilt_link", "head_pan_link", "head_tilt_joint", (0.14253, 0.0, 0.057999), _Y, limits=(-0.76, 1.45)
    ),
    TreeLink(
        "shoulder_pan_link", "torso_lift_link", "shoulder_pan_joint", (0.119525, 0.0, 0.34858), _Z,
        limits=(-1.6056, 1.6056),
    ),
    TreeLink(
        "shoulder_lift_link", "shoulder_pan_link", "shoulder_lift_joint", (0.117, 0.0, 0.06), _Y,
        limits=(-1.221, 1.518),
    ),
    TreeLink("upperarm_roll_link", "shoulder_lift_link", "upperarm_roll_joint", (0.219, 0.0, 0.0), _X),
    TreeLink(
        "elbow_flex_link", "upperarm_roll_link", "elbow_flex_joint", (0.133, 0.0, 0.0), _Y, limits=(-2.251, 2.251)
    ),
    TreeLink("forearm_roll_link", "elbow_flex_link", "forearm_roll_joint", (0.197, 0.0, 0.0), _X),
    TreeLink(
        "wrist_flex_link", "forearm_roll_link", "wrist_flex_joint", (0.1245, 0.0, 0.0), _Y, limits=(-2.16, 2.16)
    ),
    TreeLink("wrist_roll_link", "wrist_flex_link", "wrist_roll_joint", (0.1385, 0.0, 0.0), _X),
    TreeLink("gripper_link", "wrist_roll_link", "", (0.16645, 0.0, 0.0)),
    TreeLink(
        "r_gripper_finger_link", "gripper_link", "r_gripper_finger_joint", (0.0, 0.015425, 0.0), _Y, True, (0.0, 0.05)
    ),
    TreeLink(
        "l_gripper_finger_link", "gripper_link", "l_gripper_finger_joint", (0.0, -0.015425, 0.0), (0.0, -1.0, 0.0),
        True, (0.0, 0.05),
    ),
)  # fmt: skip
"""Every link below base_link, parents first. The "right" finger is at +y of the gripper, as in ManiSkill."""

LINKS: tuple[str, ...] = tuple(COLLISION)
"""Links that are bodies of the model: all those with collision shapes. Others merge into their parents."""
FINGERS: tuple[Finger, ...] = (
    Finger("l_gripper_finger_link", (0.0, -1.0, 0.0)),
    Finger("r_gripper_finger_link", (0.0, 1.0, 0.0)),
)
"""Left and right finger; their link frames are parallel to that of gripper_link."""
FINGER_LINKS: tuple[str, ...] = tuple(finger.link for finger in FINGERS)
FORCE_LINKS: tuple[str, ...] = tuple(n for n in LINKS if n not in FINGER_LINKS)
"""Links whose contact forces add up to ``robot_force``: all with collision shapes but the fingers."""
TCP_LINK = "gripper_link"
"""Link whose origin is the tcp, midway between the finger pads."""

TRUNK_LINKS = (
    "base_link",
    "torso_fixed_link",
    "torso_lift_link",
    "head_pan_link",
    "head_tilt_link",
)
ARM_LINKS = (
    "shoulder_pan_link",
    "shoulder_lift_link",
    "upperarm_roll_link",
    "elbow_flex_link",
    "forearm_roll_link",
    "wrist_flex_link",
    "torso_lift_link",
    "head_pan_link",
    "head_tilt_link",
)
DISTAL_LINKS = (
    "elbow_flex_link",
    "forearm_roll_link",
    "wrist_flex_link",
    "wrist_roll_link",
    "gripper_link",
    *FINGER_LINKS,
)
"""Links that collide with TRUNK_LINKS. No other two links of the robot collide."""

ARM_GAINS = Gains(kp=1e3, kd=1e2, force=100.0, armature=1.0)
BODY_GAINS = Gains(kp=1e3, kd=1e2, force=100.0, armature=1.0)
"""Gains of torso and head."""
GRIPPER_GAINS = Gains(kp=1e3, kd=1e2, force=100.0, armature=0.5)
BASE_GAINS = Gains(kp=0.0, kd=1e3, force=500.0, armature=0.0)
STIFF_GAINS = Gains(kp=1e5, kd=1e5, force=1e5, armature=1.0)
"""Gains of head and torso in pd_joint_delta_pos_stiff_body. As kd = kp, they approach a target within seconds."""

CAMERAS: tuple[CameraMount, ...] = (
    CameraMount("fetch_head", "head_tilt_link", (0.055, 0.0, 0.0225), LOOK_FORWARD, 2.0),
    CameraMount("fetch_hand", "gripper_link", (-0.1, 0.0, 0.1), LOOK_FORWARD, 2.0),
)
"""Head and hand camera. The head camera is at head_camera_link, which is fixed to head_tilt_link."""
