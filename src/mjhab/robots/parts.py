"""Frozen dataclasses of the parts of a `Robot`: links, masses, servos, cameras, gripper, action ranges.

Lengths [m], angles [rad], masses [kg], forces [N or N m], quaternions wxyz.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mjhab.scenes.spec import IDENTITY, Geom, Quat, Vec3

UNBOUNDED = (-math.inf, math.inf)
"""Limits of a joint without limits [rad]."""


@dataclass(frozen=True)
class TreeLink:
    """One link of a robot and the joint that moves it.

    Attributes:
        link: name of the link.
        parent: name of its parent link.
        joint: name of the joint; "" for a link fixed to its parent.
        origin: position of the link frame in the parent's frame at joint position 0 [m].
        axis: unit vector of the joint axis in the link frame.
        slide: the joint is prismatic; otherwise it is a hinge.
        limits: (low, high) of the joint [m or rad].
        quat: orientation of the link frame in the parent's frame at joint position 0, wxyz.
    """

    link: str
    parent: str
    joint: str
    origin: Vec3
    axis: Vec3 = (0.0, 0.0, 0.0)
    slide: bool = False
    limits: tuple[float, float] = UNBOUNDED
    quat: Quat = IDENTITY


@dataclass(frozen=True)
class Inertial:
    """Mass data of a link in the link frame.

    ``mass`` [kg]; ``com``: centre of mass [m]; ``inertia`` about it [kg m^2]: xx, yy, zz, xy, xz, yz (the order of
    MuJoCo's ``fullinertia``).
    """

    mass: float
    com: Vec3
    inertia: tuple[float, float, float, float, float, float]


@dataclass(frozen=True, eq=False)
class Body:
    """The links of a robot.

    Attributes:
        tree: every link below the base link, parents first.
        inertials: mass of every link.
        collision: primitive collision shapes by link, in the link frame. These links, the tcp link and those with
            joints are bodies of the model; all others merge into their parents.
    """

    tree: tuple[TreeLink, ...]
    inertials: Mapping[str, Inertial]
    collision: Mapping[str, tuple[Geom, ...]]


@dataclass(frozen=True)
class Gains:
    """Gains of a servo: force = kp * (target - q) - kd * qd, clipped to ±``force`` [N or N m].

    With kp 0 the target is a speed: force = kd * (target - qd).
    """

    kp: float
    kd: float
    force: float
    armature: float
    """Rotor inertia added to the joint [kg m^2 or kg], as that of a geared motor. It spreads the start of a motion at
    full force over two time steps, which keeps a grasped object from slipping out of the pads."""


@dataclass(frozen=True)
class Drives:
    """Servos that a control mode needs to differ from the robot's gains; `model.apply_drives` sets them.

    Attributes:
        velocity: joints whose command is a speed [rad/s or m/s]: force = kd * (command - qd).
        stiff: joints with `Robot.stiff_gains`.
    """

    velocity: tuple[str, ...] = ()
    stiff: tuple[str, ...] = ()


@dataclass(frozen=True)
class CameraMount:
    """A camera of the robot.

    ``pos`` [m] and ``quat`` (wxyz) are in the frame of link ``body``, in MuJoCo's convention: the camera looks along -z
    with y up. ``resolution`` is (width, height) [pixels].
    """

    name: str
    body: str
    pos: Vec3
    quat: Quat
    fovy: float
    """Vertical field of view [rad]."""
    resolution: tuple[int, int] = (128, 128)


LOOK_FORWARD: Quat = (0.5, 0.5, -0.5, -0.5)
"""Orientation of a camera that looks along +x of its body with +z up."""


@dataclass(frozen=True)
class Finger:
    """A finger of a parallel gripper: its link, and the unit direction in which it opens, in the link frame."""

    link: str
    opens: Vec3


@dataclass(frozen=True)
class Sphere:
    """A sphere fixed to a link: centre [m] in the frame of the link, radius [m]."""

    center: Vec3
    radius: float


@dataclass(frozen=True)
class Gripper:
    """Sizes of a parallel gripper [m], in the tcp frame: x along the fingers, y the line on which they close.

    Attributes:
        finger: half-extents of a finger along x and z.
        thickness: extent of a finger along y.
        palm_x: range (low, high) of the palm along x.
        palm_half: half-extents of the palm along y and z.
        opening: distance between the pads of the open gripper.
        usable: width of the widest object to grasp, somewhat less than ``opening``.
        shelf_usable: the same in a shelf, where few grasps are in reach.
        play: gap on each side between the open fingertips and the chord of an object that is too wide for the gripper.
        blunt: length of the rounded end of the pads, which does not count as contact with flat sides.
        hand: spheres that cover palm and wrist.
    """

    finger: tuple[float, float]
    thickness: float
    palm_x: tuple[float, float]
    palm_half: tuple[float, float]
    opening: float
    usable: float
    shelf_usable: float
    play: float = 0.0007
    blunt: float = 0.0
    hand: tuple[Sphere, ...] = ()


@dataclass(frozen=True)
class ActionColumns:
    """Columns of an action of the default control mode with base control "forward".

    The order is arm, gripper, head, torso, base; ``body`` covers head and torso.
    """

    arm: slice
    gripper: int
    body: slice
    head: tuple[int, ...]
    torso: tuple[int, ...]
    base_forward: int
    base_yaw: int

    @property
    def dim(self) -> int:
        """Size of an action."""
        return self.base_yaw + 1


@dataclass(frozen=True)
class ActionLimits:
    """Ranges that actions of ±1 are scaled to."""

    joint_delta: float = 0.1
    """Change of arm and head joints [rad] and torso [m] per control step."""
    gripper: tuple[float, float] = (-0.01, 0.05)
    """Commanded finger position [m] at -1 and +1; a negative one makes closed fingers press."""
    forward: float = 1.0
    """Base speed [m/s], forward and (holonomic) to the left."""
    yaw_rate: float = 3.14
    """Yaw rate of the base [rad/s]."""
    joint_speed: float = 1.0
    """Speed of the arm joints in the velocity modes [rad/s]."""
    ee_move: float = 0.1
    """Change of the tcp position per control step along each axis [m]."""
    ee_turn: float = 0.1
    """Largest norm of the rotation vector of the tcp per control step [rad]."""

    def gripper_entry(self, opening: Any) -> Any:
        """Entry of an action for a distance ``opening`` [m] between the fingers, a number or an array; not clipped."""
        low, high = self.gripper
        return (opening - low - high) / (high - low)
