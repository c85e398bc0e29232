"""Add a robot to an ``MjSpec``, and set its servos in a compiled model."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from mjhab.core.errors import unknown_name
from mjhab.core.timing import TIMESTEP_SECONDS
from mjhab.robots.parts import Drives, Gains, TreeLink
from mjhab.robots.robot import BASE_LIMITS, Robot
from mjhab.scenes import contact_bits
from mjhab.scenes.spec import Geom, Vec3

PAD_FRICTION = (1.15, 0.02, 0.001)
"""Friction of all contacts of a finger pad: sliding, torsional [m], rolling [m]. In MS-HAB pads have 2.0 and everything
else 0.3, which PhysX averages to 1.15. In MuJoCo the pads have a higher priority, so that their value is used alone."""
PAD_SOLIMP = (0.95, 0.99, 0.001, 0.5, 2.0)
"""MuJoCo's ``solimp`` of pad contacts."""
PAD_SOLREF = (-2500.0, -160.0)
"""MuJoCo's ``solref`` of pad contacts in its direct form: negative stiffness [1/s^2] and damping [1/s].

The stiffness is that of MuJoCo's default time constant 0.02 s, the damping 1.6 times the default. A contact constraint
neglects the centripetal acceleration: in a hand that turns at rate w at radius r, a held object drifts outwards by
w^2 r (1/damping - timestep/2) per second. At 1 rad/s and 1 m that is 5 mm/s with the default damping 100 and 1.3 mm/s
with 160. Contacts oscillate as the damping approaches 2/timestep = 200; at 180 the grasp benchmark loses a box."""

_AXES: tuple[Vec3, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_GEOM_TYPE = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_MESH,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}
PRISM_SIDES = 24
"""Sides of the prism that stands for a cylinder of a robot.

MuJoCo 3.14 to 4.0 (multiccd) give the contact of a cylinder with an edge of a box that is parallel to its axis a normal
that is up to 90 degrees off, and too little depth: three in four contacts of an upright cylinder with a thin leg. The
base of a robot went through legs of tables until the contact flipped, with 200,000 to 700,000 N. Polyhedra are right.
"""


def physics_options(spec: mujoco.MjSpec) -> None:
    """Set compiler and solver options: 100 Hz, implicitfast, Newton, elliptic cones, sleeping; angles in radians."""
    spec.compiler.degree = False
    spec.compiler.autolimits = True
    # Furniture that does not move becomes one body, which the broad phase searches as one tree.
    spec.compiler.fusestatic = True
    spec.compiler.boundinertia = 1e-6
    option = spec.option
    option.timestep = TIMESTEP_SECONDS
    # Euler lets held objects slip out of the hand at this time step.
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # With pyramids held cylinders and hulls slip, whatever the impratio.
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # At 1 held objects turn and slip sideways; 100 gains nothing more.
    option.impratio = 10.0
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    # The solver stops on convergence; with 4 or fewer, objects were thrown off with 1,000 m/s.
    option.iterations = 100
    option.ls_iterations = 50
    # MuJoCo's 0.001 keeps more objects awake, and a step takes longer with every one of them.
    option.sleep_tolerance = 0.005
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    # Stated, because a sensor silently drops further contacts.
    spec.add_numeric(name="contact_sensor_maxmatch", data=[64.0], size=1)


def add_robot(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Add a robot to a spec: links, joints, actuators, cameras. At qpos 0 it stands at the world origin, facing +x.

    Bodies have the names of its links, joints and actuators those of its joints (in the same order), cameras those of
    its cameras. Sets the compiler to radians. Compiling raises a ValueError if one of the names is taken.
    """
    spec.compiler.degree = False
    _add_prisms(spec, robot)
    bodies = {robot.base_link: _add_base(spec, robot)}
    for entry in robot.body.tree:
        body = bodies[entry.parent].add_body(
            name=entry.link, pos=entry.origin, quat=entry.quat
        )
        bodies[entry.link] = body
        _fill_body(body, entry.link, robot)
        if entry.joint:
            _add_tree_joint(body, entry, robot)
    for mount in robot.cameras:
        bodies[mount.body].add_camera(
            name=mount.name,
            pos=mount.pos,
            quat=mount.quat,
            fovy=math.degrees(mount.fovy),
            resolution=list(mount.resolution),
        )
    _add_actuators(spec, robot)


def _add_prisms(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Add the mesh of every cylinder of a robot, under the name of its geom."""
    for link, geoms in robot.body.collision.items():
        for i, geom in enumerate(geoms):
            if geom.shape == "cylinder":
                vertices = prism(geom.size[0], geom.size[1])
                spec.add_mesh(name=_geom_name(link, i), uservert=vertices.ravel())


def prism(radius: float, half_length: float) -> np.ndarray:
    """Corners (2 x PRISM_SIDES, 3) [m] of a prism about z with the volume of a cylinder.

    Its corners lie 0.6 % outside of the cylinder, the middles of its sides 0.3 % inside.
    """
    angle = np.arange(PRISM_SIDES) * (2 * np.pi / PRISM_SIDES)
    turn = 2 * np.pi / PRISM_SIDES
    # Equal area of circle and polygon, so that mass and volume stay those of the cylinder.
    corner = radius * math.sqrt(turn / math.sin(turn))
    ring = np.stack([corner * np.cos(angle), corner * np.sin(angle)], axis=1)
    ends = [
        np.column_stack([ring, np.full(PRISM_SIDES, z)])
        for z in (-half_length, half_length)
    ]
    return np.concatenate(ends)


def _geom_name(link: str, index: int) -> str:
    return f"{link}/{index}"


def _add_base(spec: mujoco.MjSpec, robot: Robot) -> mujoco.MjsBody:
    base = spec.worldbody.add_body(
        name=robot.base_link, pos=[0.0, 0.0, robot.base_height]
    )
    _fill_body(base, robot.base_link, robot)
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    rows = zip(
        robot.group("base"), (slide, slide, hinge), _AXES, BASE_LIMITS, strict=True
    )
    for name, kind, axis, limits in rows:
        joint = base.add_joint(name=name, type=kind, axis=axis)
        _limit(joint, robot.gains_of[name], limits)
    return base


def _fill_body(body: mujoco.MjsBody, link: str, robot: Robot) -> None:
    inertial = robot.body.inertials[link]
    body.explicitinertial = True
    body.mass = inertial.mass
    body.ipos = inertial.com
    body.fullinertia = inertial.inertia
    body.gravcomp = 1.0  # MS-HAB switches gravity off for every robot link
    # Links without joint stay bodies if their forces or poses are read.
    body.fuse = link not in robot.links and link != robot.tcp
    for i, geom in enumerate(robot.body.collision.get(link, ())):
        _add_collision(body, link, i, geom, robot)


def _add_collision(
    body: mujoco.MjsBody, link: str, index: int, geom: Geom, robot: Robot
) -> None:
    distal = contact_bits.DISTAL if link in robot.distal_links else 0
    trunk = contact_bits.DISTAL if link in robot.trunk_links else 0
    added = body.add_geom(
        name=_geom_name(link, index),
        type=_GEOM_TYPE[geom.shape],
        size=geom.size,
        pos=geom.pos,
        quat=geom.quat,
        contype=contact_bits.ROBOT | distal,
        # Distal links have the bit as a type and the trunk as an affinity: the arm meets the trunk, and no other two
        # links.
        conaffinity=contact_bits.ROBOT_AFFINITY | trunk,
        # Hidden by MuJoCo's viewer, which shows groups 0 to 2: visual meshes stand for them.
        group=3,
    )
    if geom.shape == "cylinder":
        added.meshname = _geom_name(link, index)
    if link in robot.finger_links:
        # Torsional friction as in the original's patch radius of 0.1 m: without it objects turn between the pads.
        added.condim = 4
        added.friction = PAD_FRICTION
        # Above all others, so that friction and softness are those of the pad whatever it touches.
        added.priority = 1
        added.solref = PAD_SOLREF
        added.solimp = PAD_SOLIMP


def _add_tree_joint(body: mujoco.MjsBody, entry: TreeLink, robot: Robot) -> None:
    kind = mujoco.mjtJoint.mjJNT_SLIDE if entry.slide else mujoco.mjtJoint.mjJNT_HINGE
    joint = body.add_joint(name=entry.joint, type=kind, axis=entry.axis)
    _limit(joint, robot.gains_of[entry.joint], entry.limits)


def _limit(joint: mujoco.MjsJoint, gains: Gains, limits: tuple[float, float]) -> None:
    """Set armature, force limit and range of a joint; the range [m or rad] only if it is finite."""
    joint.armature = gains.armature
    # The force limit is on the joint, not on the actuator: while an actuator's own force range clips it, the
    # integrator does not treat the servo's damping implicitly, and light joints oscillate between the limits.
    joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
    joint.actfrcrange = [-gains.force, gains.force]
    low, high = limits
    if math.isfinite(low):
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.range = [low, high]
    else:
        # Said in words: the compiler would else infer it from a range that is not set.
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE


def _add_actuators(spec: mujoco.MjSpec, robot: Robot) -> None:
    for name in robot.joints:
        gains = robot.gains_of[name]
        actuator = spec.add_actuator(
            name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        if gains.kp > 0:
            actuator.set_to_position(kp=gains.kp, kv=gains.kd)
        else:
            # No stiffness means a speed is commanded, as for the base.
            actuator.set_to_velocity(kv=gains.kd)
    # Both finger servos have the same command. The equality keeps the fingers symmetric, so that a grasped object does
    # not move sideways.
    first, second = robot.group("fingers")
    spec.add_equality(
        name="finger_mimic",
        type=mujoco.mjtEq.mjEQ_JOINT,
        name1=first,
        name2=second,
        data=[0.0, 1.0] + [0.0] * 10,
    )


def apply_drives(model: mujoco.MjModel, robot: Robot, drives: Drives) -> None:
    """Set servo gains and joint force limits of a compiled model in place.

    `Drives()` restores those it was compiled with.

    Raises:
        UsageError: ``drives`` names a joint that the robot lacks.
    """
    for name in (*drives.velocity, *drives.stiff):
        if name not in robot.joints:
            raise unknown_name("joint", name, robot.joints)
    for name in robot.joints:
        gains = robot.stiff_gains if name in drives.stiff else robot.gains_of[name]
        kp = 0.0 if name in drives.velocity else gains.kp
        servo = model.actuator(name)
        # MuJoCo multiplies the command by this number: a speed by the damping, a position by the stiffness.
        servo.gainprm[0] = kp or gains.kd
        servo.biasprm[:3] = 0.0, -kp, -gains.kd
        model.jnt_actfrcrange[model.joint(name).id] = -gains.force, gains.force
