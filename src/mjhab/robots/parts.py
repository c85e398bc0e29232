"""What a robot is made of: links, masses, servos, cameras, fingers. Plain frozen data.

Lengths [m], angles [rad], masses [kg], forces [N or N m], quaternions wxyz.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from mjhab.scenes.spec import IDENTITY, Geom, Quat, Vec3

FREE = (-math.inf, math.inf)
"""Limits of a joint that turns without end."""


@dataclass(frozen=True)
class TreeLink:
    """One link: ``joint`` "" is a fixed mount; ``origin``, ``quat``: pose of the link frame in its parent at 0.

    ``axis``: unit vector in the frame of the link; ``slide``: the joint is prismatic; ``limits`` [m or rad].
    """

    link: str
    parent: str
    joint: str
    origin: Vec3
    axis: Vec3 = (0.0, 0.0, 0.0)
    slide: bool = False
    limits: tuple[float, float] = FREE
    quat: Quat = IDENTITY


@dataclass(frozen=True)
class Inertial:
    """Mass, centre of mass and inertia about it: xx, yy, zz, xy, xz, yz (MuJoCo's ``fullinertia`` order)."""

    mass: float
    com: Vec3
    inertia: tuple[float, float, float, float, float, float]


@dataclass(frozen=True, eq=False)
class Body:
    """The links of a robot.

    Attributes:
        tree: every link below the base link, parents first.
        inertials: mass of every link.
        collision: primitive shapes of every link that collides, in the frame of the link. These links, the tool
            centre and those that joints move are bodies of the model; others merge into their parents.
    """

    tree: tuple[TreeLink, ...]
    inertials: Mapping[str, Inertial]
    collision: Mapping[str, tuple[Geom, ...]]


@dataclass(frozen=True)
class Gains:
    """Servo: force = kp * (target - q) - kd * qd, clipped to ±force (base: kp 0, force = kd * (target - qd))."""

    kp: float
    kd: float
    force: float
    armature: float
    """Rotor inertia added to each joint [kg m^2 or kg], as the geared motors of a real arm have it. It spreads the
    full-force start of a motion over two time steps, so that a grasped object is not jerked out of the pads."""


@dataclass(frozen=True)
class Drives:
    """Which servos differ from the robot's gains. A control mode asks for them, `model.apply_drives` sets them.

    velocity: joints whose command is a speed [rad/s or m/s]: force = kd * (command - qd);
    stiff: joints with the robot's stiff gains.
    """

    velocity: tuple[str, ...] = ()
    stiff: tuple[str, ...] = ()


@dataclass(frozen=True)
class CameraMount:
    """A camera of the robot. ``pos``, ``quat`` in ``body``; MuJoCo convention: looks along -z, y is up."""

    name: str
    body: str
    pos: Vec3
    quat: Quat
    fovy: float
    """Vertical field of view [rad]."""
    resolution: tuple[int, int] = (128, 128)
    near: float = 0.01
    far: float = 100.0


LOOK_FORWARD: Quat = (0.5, 0.5, -0.5, -0.5)
"""Orientation of a camera that looks along +x of its body with +z up."""


@dataclass(frozen=True)
class Finger:
    """A finger of a parallel gripper: its link, and the direction in which it opens, in the frame of the link."""

    link: str
    opens: Vec3


@dataclass(frozen=True)
class Sphere:
    """A sphere fixed to a link: centre [m] in the frame of the link, radius [m]."""

    center: Vec3
    radius: float


@dataclass(frozen=True)
class Gripper:
    """Sizes of a parallel gripper. Frame: that of the tool centre, x along the fingers, y the line on which they close.

    Fingers reach ``finger`` (x, z) to both sides of the origin and are ``thickness`` thick; the hand's body lies
    between ``palm_x``; ``palm_half`` are its half-extents (y, z). ``usable``: widest object taken between the pads,
    somewhat less than their widest opening ``opening``, and
    ``shelf_usable`` in a shelf, where there is little choice; ``play``: room left on both sides by fingertips that come
    to meet something wider; ``blunt``: end of the pads that is round and does not count where they lie on flat sides.
    ``hand``: spheres that cover hand and wrist.
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
    """Where the parts of a robot are in an action of the default control mode with the base "forward".

    ``arm``, ``gripper``, then head and torso (``body``; ``head``, ``torso`` name its columns), then the base.
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
        """Numbers in an action."""
        return self.base_yaw + 1


@dataclass(frozen=True)
class ActionLimits:
    """What an action of ±1 means."""

    joint_delta: float = 0.1
    """Arm, head [rad] and torso [m] change per control step."""
    gripper: tuple[float, float] = (-0.01, 0.05)
    """Finger position [m] at -1 and +1; below zero squeezes."""
    forward: float = 1.0
    """Base speed [m/s], forward and (holonomic) to the left."""
    yaw_rate: float = 3.14
    """Base turning speed [rad/s]."""
    joint_speed: float = 1.0
    """Arm joints in the velocity modes [rad/s]."""
    ee_move: float = 0.1
    """End effector: change per control step along each axis [m]."""
    ee_turn: float = 0.1
    """End effector: longest rotation vector per control step [rad]."""
