"""The `Robot` spec of the Panda arm on the Omron base."""

from __future__ import annotations

import math

import numpy as np

from mjhab.core.rotations import quat_from_axis_angle, quat_mul
from mjhab.robots.panda_omron.geometry import BASE_LINK, COLUMN, TCP, load_body
from mjhab.robots.parts import (
    LOOK_FORWARD,
    ActionLimits,
    CameraMount,
    Finger,
    Gains,
    Gripper,
    Sphere,
)
from mjhab.robots.robot import ArmReach, Footprint, Robot
from mjhab.scenes.builtin.materials import Material
from mjhab.scenes.shapes.meshes import Mesh

ARM_JOINTS = tuple(f"joint{k}" for k in range(1, 8))
ARM_LINKS = tuple(f"link{k}" for k in range(1, 8))
FINGERS = (Finger("leftfinger", (0.0, -1.0, 0.0)), Finger("rightfinger", (0.0, 1.0, 0.0)))
COLUMN_AT_REST_M = 0.1
"""Rest position of the lifting joint [m]."""
_PITCH = 0.5
_LOOK_DOWN = tuple(
    float(x)
    for x in quat_mul(
        quat_from_axis_angle(np.array([0.0, 1.0, 0.0]), np.array(_PITCH)),
        np.array(LOOK_FORWARD),
    )
)
"""Orientation (wxyz) of a camera that looks along +x of its body, pitched down by ``_PITCH`` [rad]."""
READY = (0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, 0.0, 0.0)
"""Arm joint positions [rad] of Franka's ready posture: the hand points straight down in front of the base."""
FINGERS_AT_REST_M = 0.015
"""Rest position of each finger [m]."""
_HAND_RADIUS = 0.034
_WRIST_RADIUS = 0.06
_HAND = tuple(
    Sphere((x, y, 0.0), _HAND_RADIUS)
    for x in (-0.061, -0.085)
    for y in (-0.072, -0.036, 0.0, 0.036, 0.072)
)
_WRIST = tuple(Sphere((x, -0.015, 0.0), _WRIST_RADIUS) for x in (-0.13, -0.18))
GRIPPER = Gripper(
    finger=(0.0134, 0.0100),
    thickness=0.0226,
    palm_x=(-0.112, -0.0268),
    palm_half=(0.104, 0.032),
    opening=0.0795,
    usable=0.0785,
    shelf_usable=0.0785,
    hand=_HAND + _WRIST,
)
"""Sizes from the bounds of the meshes of ``grippers/panda_gripper.xml``; each finger opens by 4 cm."""
SERVO = Gains(kp=1e3, kd=1e2, force=100.0, armature=1.0)
"""Servo gains of ManiSkill's Fetch, so that both robots respond equally to an action."""


def _visuals() -> list[tuple[str, Mesh, str]]:
    # The module imports trimesh, which is slow to import.
    from mjhab.robots.panda_omron.visuals import robot_meshes

    return robot_meshes()


ROBOT = Robot(
    name="panda_omron",
    joints=(
        "joint_mobile_forward",
        "joint_mobile_side",
        "joint_mobile_yaw",
        "joint_torso_height",
        *ARM_JOINTS,
        "finger_joint1",
        "finger_joint2",
    ),
    groups={
        "base": ("joint_mobile_forward", "joint_mobile_side", "joint_mobile_yaw"),
        "torso": ("joint_torso_height",),
        "arm": ARM_JOINTS,
        "fingers": ("finger_joint1", "finger_joint2"),
    },
    load_body=load_body,
    rest_qpos=(
        *(0.0, 0.0, 0.0),
        COLUMN_AT_REST_M,
        *READY,
        *(FINGERS_AT_REST_M, FINGERS_AT_REST_M),
    ),
    base_link=BASE_LINK,
    # As Fetch: no contact with the floor, so that driving adds no force.
    base_height=0.02,
    arm_root=COLUMN,
    tcp=TCP,
    fingers=FINGERS,
    force_links=(BASE_LINK, COLUMN, "link0", *ARM_LINKS, "right_gripper"),
    trunk_links=(BASE_LINK, COLUMN, "link0"),
    distal_links=(
        "link5",
        "link6",
        "link7",
        "right_gripper",
        "leftfinger",
        "rightfinger",
    ),
    arm_links=(COLUMN, "link0", "link1", "link2", "link3", "link4", "link5", "link6"),
    wrist_links=("link6", "link7", "right_gripper"),
    cameras=(
        CameraMount("panda_omron_head", COLUMN, (-0.35, 0.0, 0.95), _LOOK_DOWN, 1.6),  # pyright: ignore[reportArgumentType]
        CameraMount(
            "panda_omron_hand", "right_gripper", (0.02, 0.0, 0.10), LOOK_FORWARD, 1.6
        ),
    ),
    gains={
        "base": Gains(kp=0.0, kd=1e3, force=600.0, armature=0.0),
        "torso": SERVO,
        "arm": SERVO,
        "fingers": Gains(kp=1e3, kd=1e2, force=20.0, armature=1.0),
    },
    stiff_gains=Gains(kp=1e5, kd=1e5, force=1e5, armature=1.0),
    gripper=GRIPPER,
    footprint=Footprint(radius=0.40, spawn=0.36, wide=0.38, narrow=0.31, top=0.39),
    reach=ArmReach(
        ahead=0.21,
        out=0.0,
        low=1.033,
        high=1.373,
        length=0.62,
        hand=0.20,
        level=(0.30, 0.80),
    ),
    elbow="joint4",
    visuals=_visuals,
    limits=ActionLimits(gripper=(-0.01, 0.04)),
    materials={
        "panda_white": Material((0.92, 0.92, 0.93), gloss=0.4),
        "panda_grey": Material((0.50, 0.50, 0.51), gloss=0.3),
        "omron_grey": Material((0.72, 0.72, 0.74), gloss=0.3),
        "omron_dark": Material((0.16, 0.15, 0.17), gloss=0.2),
    },
)
