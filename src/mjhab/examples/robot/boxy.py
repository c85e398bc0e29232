"""A new robot in one file: Boxy, an arm of seven joints on a round base, without torso and head.

    MJHAB_PLUGINS=examples/robot/boxy.py mjhab robots list
    MJHAB_PLUGINS=examples/robot/boxy.py mjhab generate --robot boxy --subtask pick --episodes 2 --out runs/boxy

All link frames are parallel to each other when the joints are at zero: x forward, y left, z up. The arm then points
forward. Lengths [m], angles [rad], masses [kg].
"""

from __future__ import annotations

import mjhab
from mjhab.robots.parts import (
    LOOK_FORWARD,
    UNBOUNDED,
    Body,
    CameraMount,
    Finger,
    Gains,
    Gripper,
    Inertial,
    Sphere,
    TreeLink,
)
from mjhab.robots.robot import ArmReach, Footprint, Robot
from mjhab.scenes.builtin.materials import Material
from mjhab.scenes.spec import Geom

X = (1.0, 0.0, 0.0)
Y = (0.0, 1.0, 0.0)
Z = (0.0, 0.0, 1.0)
BEND = (-2.2, 2.2)
TREE = (
    TreeLink("mast", "base", "", (0.10, 0.0, 0.36)),
    TreeLink("turret", "mast", "turn", (0.0, 0.0, 0.65), Z, limits=(-2.8, 2.8)),
    TreeLink("upper", "turret", "lift", (0.10, 0.0, 0.06), Y, limits=(-1.6, 1.6)),
    TreeLink("upper_roll", "upper", "twist", (0.18, 0.0, 0.0), X, limits=UNBOUNDED),
    TreeLink("fore", "upper_roll", "elbow", (0.17, 0.0, 0.0), Y, limits=BEND),
    TreeLink("fore_roll", "fore", "roll", (0.16, 0.0, 0.0), X, limits=UNBOUNDED),
    TreeLink("wrist", "fore_roll", "nod", (0.15, 0.0, 0.0), Y, limits=BEND),
    TreeLink("palm", "wrist", "spin", (0.11, 0.0, 0.0), X, limits=UNBOUNDED),
    TreeLink("grip", "palm", "", (0.15, 0.0, 0.0)),
    TreeLink("left", "grip", "left_finger", (0.0, 0.0, 0.0), Y, True, (0.0, 0.05)),
    TreeLink(
        "right",
        "grip",
        "right_finger",
        (0.0, 0.0, 0.0),
        (0.0, -1.0, 0.0),
        True,
        (0.0, 0.05),
    ),
)
"""Every link: name, parent, joint between them ("" for none), place in the parent, axis, whether it slides, limits."""


def capsule(length: float, radius: float = 0.045) -> Geom:
    """A capsule along x from the origin of its link."""
    turned = (0.7071067811865476, 0.0, 0.7071067811865476, 0.0)
    return Geom(
        "capsule", (radius, length / 2, 0.0), (length / 2, 0.0, 0.0), turned, visual=False
    )


def finger(side: float) -> Geom:
    """A finger whose pad lies on the plane y = 0 while it is shut."""
    return Geom("box", (0.03, 0.007, 0.013), (0.0, side * 0.007, 0.0), visual=False)


COLLISION = {
    "base": (Geom("cylinder", (0.27, 0.17, 0.0), (0.0, 0.0, 0.18), visual=False),),
    "mast": (Geom("cylinder", (0.07, 0.31, 0.0), (0.0, 0.0, 0.30), visual=False),),
    "turret": (Geom("cylinder", (0.06, 0.06, 0.0), (0.0, 0.0, 0.05), visual=False),),
    "upper": (capsule(0.14),),
    "upper_roll": (capsule(0.13),),
    "fore": (capsule(0.12),),
    "fore_roll": (capsule(0.11),),
    "wrist": (capsule(0.08, 0.04),),
    "palm": (Geom("box", (0.05, 0.06, 0.035), (0.06, 0.0, 0.0), visual=False),),
    "left": (finger(1.0),),
    "right": (finger(-1.0),),
}
"""Boxes, cylinders, capsules and spheres of every link that can touch something."""


def mass(kilograms: float) -> Inertial:
    """A mass at the origin of a link with the inertia of a ball of 10 cm."""
    about = 0.004 * kilograms
    return Inertial(kilograms, (0.0, 0.0, 0.0), (about, about, about, 0.0, 0.0, 0.0))


MASSES = {"base": 40.0, "mast": 8.0, "left": 0.1, "right": 0.1, "grip": 0.1}
INERTIALS = {
    link: mass(MASSES.get(link, 2.0)) for link in ("base", *(row.link for row in TREE))
}
SERVO = Gains(kp=1e3, kd=1e2, force=100.0, armature=1.0)


def looks() -> list:
    """Boxy looks like its collision shapes."""
    from mjhab.robots.meshes import meshes_of_shapes

    return meshes_of_shapes(COLLISION, "boxy_orange")


BOXY = Robot(
    name="boxy",
    joints=(
        "drive_x",
        "drive_y",
        "drive_yaw",
        "turn",
        "lift",
        "twist",
        "elbow",
        "roll",
        "nod",
        "spin",
        "left_finger",
        "right_finger",
    ),
    groups={
        "base": ("drive_x", "drive_y", "drive_yaw"),
        "arm": ("turn", "lift", "twist", "elbow", "roll", "nod", "spin"),
        "fingers": ("left_finger", "right_finger"),
    },
    load_body=lambda: Body(TREE, INERTIALS, COLLISION),
    # The hand points straight down: -1.1 + 1.7 + 0.9708 is a right angle.
    rest_qpos=(0.0, 0.0, 0.0, 0.0, -1.1, 0.0, 1.7, 0.0, 0.9708, 0.0, 0.015, 0.015),
    base_link="base",
    base_height=0.02,
    arm_root="mast",
    tcp="grip",
    fingers=(Finger("right", (0.0, -1.0, 0.0)), Finger("left", (0.0, 1.0, 0.0))),
    force_links=tuple(link for link in COLLISION if link not in ("left", "right")),
    trunk_links=("base", "mast"),
    distal_links=("fore_roll", "wrist", "palm", "left", "right"),
    arm_links=("turret", "upper", "upper_roll", "fore", "fore_roll", "wrist"),
    wrist_links=("wrist", "palm"),
    cameras=(
        CameraMount("boxy_head", "mast", (-0.15, 0.0, 1.0), LOOK_FORWARD, 2.0),
        CameraMount("boxy_hand", "palm", (0.0, 0.0, 0.10), LOOK_FORWARD, 2.0),
    ),
    gains={
        "base": Gains(kp=0.0, kd=1e3, force=500.0, armature=0.0),
        "arm": SERVO,
        "fingers": Gains(kp=1e3, kd=1e2, force=100.0, armature=0.5),
    },
    stiff_gains=Gains(kp=1e5, kd=1e5, force=1e5, armature=1.0),
    gripper=Gripper(
        finger=(0.030, 0.013),
        thickness=0.014,
        palm_x=(-0.14, -0.04),
        palm_half=(0.06, 0.035),
        opening=0.1,
        usable=0.092,
        shelf_usable=0.0945,
        hand=tuple(Sphere((-0.09, y, 0.0), 0.04) for y in (-0.03, 0.0, 0.03)),
    ),
    footprint=Footprint(radius=0.28, spawn=0.3, wide=0.29, narrow=0.27, top=0.37),
    reach=ArmReach(
        ahead=0.1, out=0.1, low=1.09, high=1.09, length=0.6, hand=0.26, level=(0.3, 0.85)
    ),
    elbow="elbow",
    visuals=looks,
    materials={"boxy_orange": Material((0.90, 0.45, 0.10), gloss=0.3)},
)
"""See the docstring of `Robot` for what every field means."""

mjhab.register_robot(BOXY)
