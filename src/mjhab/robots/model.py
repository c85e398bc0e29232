"""Robots on MuJoCo: how one gets into an ``MjSpec``, and how its servos are set in a compiled model."""

from __future__ import annotations

import math

import mujoco

from mjhab.core.errors import unknown_name
from mjhab.core.timing import TIMESTEP_SECONDS
from mjhab.robots.parts import Drives, Gains, TreeLink
from mjhab.robots.robot import BASE_LIMITS, Robot
from mjhab.scenes import contact_bits
from mjhab.scenes.spec import Geom, Vec3

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

_AXES: tuple[Vec3, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
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
    option.timestep = TIMESTEP_SECONDS
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations = 100
    option.ls_iterations = 50
    option.sleep_tolerance = 0.005
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    spec.add_numeric(name="contact_sensor_maxmatch", data=[64.0], size=1)


def add_robot(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Add a robot to a model under construction, at the origin of the world, facing +x.

    Bodies are named like its links, joints and actuators like its joints, in their order, cameras like its cameras.
    Sets the compiler to radians. The pose at qpos 0 is the zero pose.

    Raises:
        ValueError: (at compile) when the model already has one of these names.
    """
    spec.compiler.degree = False
    bodies = {robot.base_link: _add_base(spec, robot)}
    for entry in robot.body.tree:
        body = bodies[entry.parent].add_body(name=entry.link, pos=entry.origin, quat=entry.quat)
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


def _add_base(spec: mujoco.MjSpec, robot: Robot) -> mujoco.MjsBody:
    base = spec.worldbody.add_body(name=robot.base_link, pos=[0.0, 0.0, robot.base_height])
    _fill_body(base, robot.base_link, robot)
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    rows = zip(robot.group("base"), (slide, slide, hinge), _AXES, BASE_LIMITS, strict=True)
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
    body.gravcomp = 1.0  # the original switches gravity off for every robot link
    # Some links have no joint but must stay bodies for their forces.
    body.fuse = link not in robot.links and link != robot.tcp
    for i, geom in enumerate(robot.body.collision.get(link, ())):
        _add_collision(body, link, i, geom, robot)


def _add_collision(body: mujoco.MjsBody, link: str, index: int, geom: Geom, robot: Robot) -> None:
    distal = contact_bits.DISTAL if link in robot.distal_links else 0
    trunk = contact_bits.DISTAL if link in robot.trunk_links else 0
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
    if link in robot.finger_links:
        added.condim = 4
        added.friction = PAD_FRICTION
        added.priority = 1
        added.solref = PAD_SOLREF
        added.solimp = PAD_SOLIMP


def _add_tree_joint(body: mujoco.MjsBody, entry: TreeLink, robot: Robot) -> None:
    kind = mujoco.mjtJoint.mjJNT_SLIDE if entry.slide else mujoco.mjtJoint.mjJNT_HINGE
    joint = body.add_joint(name=entry.joint, type=kind, axis=entry.axis)
    _limit(joint, robot.gains_of[entry.joint], entry.limits)


def _limit(joint: mujoco.MjsJoint, gains: Gains, limits: tuple[float, float]) -> None:
    """Give a joint the rotor inertia and force of its servo, and its limits where they are finite."""
    joint.armature = gains.armature
    # The limit sits on the joint, not on the actuator: the integrator stops treating the damping of a servo
    # implicitly while the actuator's own force range clips it, and light joints would chatter between the limits.
    joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
    joint.actfrcrange = [-gains.force, gains.force]
    low, high = limits
    if math.isfinite(low):
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.range = [low, high]
    else:
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE


def _add_actuators(spec: mujoco.MjSpec, robot: Robot) -> None:
    for name in robot.joints:
        gains = robot.gains_of[name]
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if gains.kp > 0:
            actuator.set_to_position(kp=gains.kp, kv=gains.kd)
        else:
            actuator.set_to_velocity(kv=gains.kd)
    # Both servos pull alike; the equality keeps the fingers symmetric, so a grasped object does not wander sideways.
    first, second = robot.group("fingers")
    spec.add_equality(
        name="finger_mimic",
        type=mujoco.mjtEq.mjEQ_JOINT,
        name1=first,
        name2=second,
        data=[0.0, 1.0] + [0.0] * 10,
    )


def apply_drives(model: mujoco.MjModel, robot: Robot, drives: Drives) -> None:
    """Set servo gains and joint force limits of a compiled model in place; `Drives()` are those it was compiled with.

    Raises:
        UsageError: a joint that the robot does not have.
    """
    for name in (*drives.velocity, *drives.stiff):
        if name not in robot.joints:
            raise unknown_name("joint", name, robot.joints)
    for name in robot.joints:
        gains = robot.stiff_gains if name in drives.stiff else robot.gains_of[name]
        kp = 0.0 if name in drives.velocity else gains.kp
        servo = model.actuator(name)
        servo.gainprm[0] = kp or gains.kd
        servo.biasprm[:3] = 0.0, -kp, -gains.kd
        model.jnt_actfrcrange[model.joint(name).id] = -gains.force, gains.force
