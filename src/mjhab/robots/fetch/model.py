"""The Fetch robot on MuJoCo: joints, limits, gains, cameras, and how to put it into an ``MjSpec``.

Numbers are those of ManiSkill's Fetch, which MS-HAB uses: ``mani_skill/assets/robots/fetch/fetch.urdf`` (tree,
limits) and ``mani_skill/agents/robots/fetch/fetch.py`` (gains, rest keyframe, cameras, grasp test). The base moves
in the plane by three joints and floats 2 cm above the floor, so it can neither tip nor scrape.
Lengths [m], angles [rad], forces [N or N m]. ``base_link`` is the frame +x forward, +z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco

from mjhab.core.errors import unknown_name
from mjhab.robots.fetch.geometry import COLLISION, INERTIALS
from mjhab.scenes import contact_bits
from mjhab.scenes.spec import Geom, Quat, Vec3

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

ACTUATORS: tuple[str, ...] = FETCH_JOINTS
"""Actuator names in the order of ctrl: one per joint, named like it. Base: speeds; the others: positions."""

REST_QPOS: tuple[float, ...] = (
    0.0, 0.0, 0.0, 0.386, 0.0, -0.370, 0.562, -1.032, 0.695, 0.955, -0.1, 2.077, 0.0, 0.015, 0.015,
)  # fmt: skip
"""Rest keyframe, FETCH_JOINTS order."""

BASE_HEIGHT = 0.02
"""Height of base_link above the floor [m]."""
_FREE = (-math.inf, math.inf)


@dataclass(frozen=True)
class TreeLink:
    """One link: ``joint`` "" is a fixed mount; ``origin``, ``quat``: pose of the link frame in its parent at 0."""

    link: str
    parent: str
    joint: str
    origin: Vec3
    axis: Vec3 = (0.0, 0.0, 0.0)
    slide: bool = False
    limits: tuple[float, float] = _FREE
    quat: Quat = (1.0, 0.0, 0.0, 0.0)


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
"""Every link below base_link, parents first. The "right" finger sits at +y of the gripper, as in the original."""

_BASE_LIMITS = ((-20.0, 20.0), (-20.0, 20.0), _FREE)
_LIMITS_BY_JOINT = dict(zip(FETCH_JOINTS[:3], _BASE_LIMITS, strict=True)) | {
    t.joint: t.limits for t in KINEMATIC_TREE if t.joint
}
JOINT_LIMITS: tuple[tuple[float, float], ...] = tuple(_LIMITS_BY_JOINT[n] for n in FETCH_JOINTS)
"""(low, high) per joint, FETCH_JOINTS order; infinite where the joint turns freely."""

LINKS: tuple[str, ...] = tuple(COLLISION)
"""Links that are bodies of the model: all with collision geometry. Others merge into their parents."""
FINGER_LINKS: tuple[str, str] = ("l_gripper_finger_link", "r_gripper_finger_link")
FINGER_OPEN_DIR: dict[str, Vec3] = {
    "l_gripper_finger_link": (0.0, -1.0, 0.0),
    "r_gripper_finger_link": (0.0, 1.0, 0.0),
}
"""Direction in which each finger opens, in its own link frame (which is parallel to gripper_link)."""
FORCE_LINKS: tuple[str, ...] = tuple(n for n in LINKS if n not in FINGER_LINKS)
"""Links whose contact force counts against the robot: all that can touch, without the fingers."""
TCP_LINK = "gripper_link"
"""Its origin is the tool centre point: midway between the finger pads."""

TRUNK_LINKS = (
    "base_link",
    "torso_fixed_link",
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
"""Links that collide with the trunk. Other pairs of robot links do not collide."""


@dataclass(frozen=True)
class Gains:
    """Servo: force = kp * (target - q) - kd * qd, clipped to ±force (base: kp 0, force = kd * (target - qd))."""

    kp: float
    kd: float
    force: float
    armature: float
    """Rotor inertia added to each joint [kg m^2 or kg], as the geared motors of a real arm have it. It spreads the
    full-force start of a motion over two time steps, so that a grasped object is not jerked out of the pads."""


ARM_GAINS = Gains(kp=1e3, kd=1e2, force=100.0, armature=1.0)
BODY_GAINS = Gains(kp=1e3, kd=1e2, force=100.0, armature=1.0)
"""Torso, head pan, head tilt."""
GRIPPER_GAINS = Gains(kp=1e3, kd=1e2, force=100.0, armature=0.5)
BASE_GAINS = Gains(kp=0.0, kd=1e3, force=500.0, armature=0.0)
_GAINS: dict[str, Gains] = dict.fromkeys(FETCH_JOINTS, ARM_GAINS)
_GAINS |= dict.fromkeys(("torso_lift_joint", "head_pan_joint", "head_tilt_joint"), BODY_GAINS)
_GAINS |= dict.fromkeys(("r_gripper_finger_joint", "l_gripper_finger_joint"), GRIPPER_GAINS)
_GAINS |= dict.fromkeys(FETCH_JOINTS[:3], BASE_GAINS)
GAINS: tuple[Gains, ...] = tuple(_GAINS[n] for n in FETCH_JOINTS)
"""Per joint, FETCH_JOINTS order."""
STIFF_GAINS = Gains(kp=1e5, kd=1e5, force=1e5, armature=1.0)
"""Head and torso in pd_joint_delta_pos_stiff_body. kd = kp: they creep to a target within seconds, whatever pushes."""


@dataclass(frozen=True)
class Drives:
    """Which servos differ from GAINS. A control mode asks for them, `apply_drives` sets them.

    velocity: joints whose command is a speed [rad/s or m/s]: force = kd * (command - qd);
    stiff: joints with STIFF_GAINS.
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
CAMERAS: tuple[CameraMount, ...] = (
    CameraMount("fetch_head", "head_tilt_link", (0.055, 0.0, 0.0225), LOOK_FORWARD, 2.0),
    CameraMount("fetch_hand", "gripper_link", (-0.1, 0.0, 0.1), LOOK_FORWARD, 2.0),
)
"""The head camera sits at head_camera_link, a fixed mount on head_tilt_link."""

PAD_FRICTION = (1.15, 0.02, 0.001)
"""Sliding, torsional [m], rolling [m] of every contact of a finger pad. The original's pads have 2.0, what they touch
has 0.3, and its engine averages the two. Here the pads' value wins by their priority: it is the average."""
PAD_SOLIMP = (0.95, 0.99, 0.001, 0.5, 2.0)
PAD_SOLREF = (-2500.0, -160.0)
"""Stiffness [1/s^2] and damping [1/s] of pad contacts (negative: MuJoCo's direct form). The stiffness is that of
MuJoCo's default 0.02 s, the damping 1.6 times. A contact does not feel the curvature of its path, so on a hand that
turns at rate w at radius r a held object drifts outwards by w^2 r (1/damping - timestep/2) per second: 5 mm/s at
1 rad/s and 1 m with the default damping of 100, 1.3 mm/s with 160. Towards 2/timestep = 200 contacts ring: the
bench loses a box at 180."""

_GEOM_TYPE = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}


def physics_options(spec: mujoco.MjSpec) -> None:
    """Set the physics recipe: 100 Hz, implicitfast, Newton, elliptic cones, sleeping; angles in radians."""
    spec.compiler.degree = False
    spec.compiler.autolimits = True
    spec.compiler.fusestatic = True
    spec.compiler.boundinertia = 1e-6
    option = spec.option
    option.timestep = 0.01
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations = 100
    option.ls_iterations = 50
    option.sleep_tolerance = 0.005
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    spec.add_numeric(name="contact_sensor_maxmatch", data=[64.0], size=1)


def add_fetch(spec: mujoco.MjSpec) -> None:
    """Add the robot to a model under construction, at the origin of the world, facing +x.

    Bodies are named as in LINKS, joints and actuators as in FETCH_JOINTS, cameras as in CAMERAS. Sets the
    compiler to radians. The pose at qpos 0 is the zero pose; the rest pose is REST_QPOS.

    Raises:
        ValueError: (at compile) when the model already has one of these names.
    """
    spec.compiler.degree = False
    bodies = {"base_link": _add_base(spec)}
    for entry in KINEMATIC_TREE:
        body = bodies[entry.parent].add_body(name=entry.link, pos=entry.origin, quat=entry.quat)
        bodies[entry.link] = body
        _fill_body(body, entry.link)
        if entry.joint:
            kind = mujoco.mjtJoint.mjJNT_SLIDE if entry.slide else mujoco.mjtJoint.mjJNT_HINGE
            _add_joint(body, entry.joint, kind, entry.axis)
    for mount in CAMERAS:
        bodies[mount.body].add_camera(
            name=mount.name,
            pos=mount.pos,
            quat=mount.quat,
            fovy=math.degrees(mount.fovy),
            resolution=list(mount.resolution),
        )
    _add_actuators(spec)


def _add_base(spec: mujoco.MjSpec) -> mujoco.MjsBody:
    base = spec.worldbody.add_body(name="base_link", pos=[0.0, 0.0, BASE_HEIGHT])
    _fill_body(base, "base_link")
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    for name, kind, axis in zip(FETCH_JOINTS[:3], (slide, slide, hinge), (_X, _Y, _Z), strict=True):
        _add_joint(base, name, kind, axis)
    return base


def _fill_body(body: mujoco.MjsBody, link: str) -> None:
    inertial = INERTIALS[link]
    body.explicitinertial = True
    body.mass = inertial.mass
    body.ipos = inertial.com
    body.fullinertia = inertial.inertia
    body.gravcomp = 1.0  # the original switches gravity off for every robot link
    body.fuse = (
        link not in COLLISION
    )  # gripper and torso_fixed have no joint but must stay bodies for their forces
    for i, geom in enumerate(COLLISION.get(link, ())):
        _add_collision(body, link, i, geom)


def _add_collision(body: mujoco.MjsBody, link: str, index: int, geom: Geom) -> None:
    distal = contact_bits.DISTAL if link in DISTAL_LINKS else 0
    trunk = contact_bits.DISTAL if link in TRUNK_LINKS else 0
    added = body.add_geom(
        name=f"{link}/{index}",
        type=_GEOM_TYPE[geom.shape],
        size=geom.size,
        pos=geom.pos,
        quat=geom.quat,
        contype=contact_bits.ROBOT | distal,
        conaffinity=contact_bits.ROBOT_AFFINITY | trunk,
        group=3,
    )
    if link in FINGER_LINKS:
        added.condim = 4
        added.friction = PAD_FRICTION
        added.priority = 1
        added.solref = PAD_SOLREF
        added.solimp = PAD_SOLIMP


def _add_joint(body: mujoco.MjsBody, name: str, kind: mujoco.mjtJoint, axis: Vec3) -> None:
    joint = body.add_joint(name=name, type=kind, axis=axis, armature=_GAINS[name].armature)
    # The limit sits on the joint, not on the actuator: the integrator stops treating the damping of a servo
    # implicitly while the actuator's own force range clips it, and light joints would chatter between the limits.
    limit = _GAINS[name].force
    joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
    joint.actfrcrange = [-limit, limit]
    low, high = _LIMITS_BY_JOINT[name]
    if math.isfinite(low):
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.range = [low, high]
    else:
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE


def _add_actuators(spec: mujoco.MjSpec) -> None:
    for name in ACTUATORS:
        gains = _GAINS[name]
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if gains.kp > 0:
            actuator.set_to_position(kp=gains.kp, kv=gains.kd)
        else:
            actuator.set_to_velocity(kv=gains.kd)
    # Both servos pull alike; the equality keeps the fingers symmetric, so a grasped object does not wander sideways.
    spec.add_equality(
        name="finger_mimic",
        type=mujoco.mjtEq.mjEQ_JOINT,
        name1="r_gripper_finger_joint",
        name2="l_gripper_finger_joint",
        data=[0.0, 1.0] + [0.0] * 10,
    )


def apply_drives(model: mujoco.MjModel, drives: Drives) -> None:
    """Set servo gains and joint force limits of a compiled model in place; `Drives()` are those it was compiled with.

    Raises:
        UsageError: a joint that the robot does not have.
    """
    for name in (*drives.velocity, *drives.stiff):
        if name not in FETCH_JOINTS:
            raise unknown_name("joint", name, FETCH_JOINTS)
    for name in ACTUATORS:
        gains = STIFF_GAINS if name in drives.stiff else _GAINS[name]
        kp = 0.0 if name in drives.velocity else gains.kp
        servo = model.actuator(name)
        servo.gainprm[0] = kp or gains.kd
        servo.biasprm[:3] = 0.0, -kp, -gains.kd
        model.jnt_actfrcrange[model.joint(name).id] = -gains.force, gains.force
