"""The `Robot` spec of Fetch, the default robot."""

from __future__ import annotations

from mjhab.robots.fetch import model
from mjhab.robots.fetch.geometry import COLLISION, INERTIALS
from mjhab.robots.fetch.gripper import GRIPPER
from mjhab.robots.fetch.materials import ROBOT_MATERIALS
from mjhab.robots.parts import Body
from mjhab.robots.robot import ArmReach, Footprint, Robot
from mjhab.scenes.shapes.meshes import Mesh


def _visuals() -> list[tuple[str, Mesh, str]]:
    # The module imports trimesh, which is slow to import.
    from mjhab.robots.fetch.visuals import robot_meshes

    return robot_meshes()


ROBOT = Robot(
    name="fetch",
    joints=model.FETCH_JOINTS,
    groups={
        "base": ("root_x_axis_joint", "root_y_axis_joint", "root_z_rotation_joint"),
        "torso": ("torso_lift_joint",),
        "head": ("head_pan_joint", "head_tilt_joint"),
        "arm": (
            "shoulder_pan_joint",
            "shoulder_lift_joint",
            "upperarm_roll_joint",
            "elbow_flex_joint",
            "forearm_roll_joint",
            "wrist_flex_joint",
            "wrist_roll_joint",
        ),
        "fingers": ("r_gripper_finger_joint", "l_gripper_finger_joint"),
    },
    load_body=lambda: Body(model.KINEMATIC_TREE, INERTIALS, COLLISION),
    rest_qpos=model.REST_QPOS,
    base_link="base_link",
    base_height=model.BASE_HEIGHT,
    arm_root="torso_lift_link",
    tcp=model.TCP_LINK,
    fingers=model.FINGERS,
    force_links=model.FORCE_LINKS,
    trunk_links=model.TRUNK_LINKS,
    distal_links=model.DISTAL_LINKS,
    arm_links=model.ARM_LINKS,
    wrist_links=("wrist_flex_link", "wrist_roll_link"),
    cameras=model.CAMERAS,
    gains={
        "base": model.BASE_GAINS,
        "torso": model.BODY_GAINS,
        "head": model.BODY_GAINS,
        "arm": model.ARM_GAINS,
        "fingers": model.GRIPPER_GAINS,
    },
    stiff_gains=model.STIFF_GAINS,
    gripper=GRIPPER,
    ee_rest_pos=(0.5, 0.0, 1.25),
    # HAB's navigation meshes use a radius of 0.3 m.
    footprint=Footprint(radius=0.285, spawn=0.3, wide=0.29, narrow=0.27, top=0.40),
    reach=ArmReach(
        ahead=0.033,
        out=0.117,
        low=0.806,
        high=1.192,
        length=0.624,
        hand=0.305,
        level=(0.35, 0.95),
    ),
    elbow="elbow_flex_joint",
    visuals=_visuals,
    materials=ROBOT_MATERIALS,
)
"""The Fetch robot. ``ee_rest_pos`` is that of MS-HAB's success tests (mshab/envs/planner.py)."""
