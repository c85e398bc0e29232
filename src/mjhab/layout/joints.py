"""Joints of furniture in the model: range, stops, damping, dry friction, armature, by ``EnvConfig.joint_dynamics``.

"ours": the constants below, MuJoCo's default stops, and a range that ends where the home says that a wall stops a door.

"published": what the files of the furniture say (`Link.damping`, `Link.friction`, `Link.range`, `Link.inertial`), no
armature, and stops that do not bounce. All URDFs of ReplicaCAD say 0.01 and 0.01. Built-in furniture stands in for them
and has the same; how its mass is spread follows from its shapes. The centre of mass matters: the fridge of ReplicaCAD
leans by 0.33 deg, and with the centre of mass of their shapes its doors, which nothing holds any more, would fall shut;
its file puts it on the hinge. Where a home says that a wall stops a door, the door keeps its published range and
collides with the walls. In MS-HAB doors and the stage are in one collision group and never meet (ManiSkill's ReplicaCAD
scene builder), so that a door may stand in the wall. Homes of ReplicaCAD name such doors only with a stand-in for their
stage: with the stage itself a door passes through its walls, as in MS-HAB.
"""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from mjhab.scenes import contact_bits
from mjhab.scenes.spec import PUBLISHED_DYNAMICS, Articulation, Home, Link

SLIDE_DAMPING = 5.0
"""Damping of drawers [N s/m]."""
SLIDE_FRICTION = 1.0
"""Dry friction of drawers [N]."""
HINGE_DAMPING = 1.0
"""Damping of doors [N m s/rad]."""
HINGE_FRICTION = 0.5
"""Dry friction of doors [N m]."""
JOINT_ARMATURE = 0.1
"""Armature of the joints of furniture [kg or kg m^2]."""
STOP_SOLREF = (-25.0, -100.0)
"""MuJoCo's ``solref`` of stops that do not bounce, in its direct form: negative stiffness [1/s^2] and damping [1/s].

The damping takes the whole speed in one time step of 10 ms; the stiffness brings the joint back to its limit in some
seconds, too slowly to throw it off: a drawer of 4 kg leaves the stop with at most 0.2 % of its speed. MuJoCo's default
stop returns up to 16 %, which without damping carries it to the other end."""
STOP_SOLIMP = (0.99, 0.999, 0.001, 0.5, 2.0)
"""MuJoCo's ``solimp`` of these stops. A push of 40 N at a shut drawer creeps 0.8 mm in 3 s; with solref (0.02, 20) and
the default solimp it creeps 14 mm."""


_NO_WEIGHT = 1e-6
"""Inverse weights below this are none [1/kg]."""


def stopped_links(homes: Iterable[Home]) -> frozenset[str]:
    """Ids of the links that a wall stops in any of the homes before the end of their range."""
    return frozenset(link for home in homes for link, _ in home.open_limits)


def add_joint(
    body: mujoco.MjsBody, name: str, link: Link, dynamics: str, limit: float
) -> None:
    """Add the joint of a link of furniture to its body.

    Args:
        body: body of the link.
        name: of the joint.
        link: the link.
        dynamics: one of `spec.JOINT_DYNAMICS`.
        limit: largest joint position before a wall [m or rad], from `Home.open_limits`; infinite for none.
    """
    slide = link.joint == "slide"
    low, high = link.range
    joint = body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE,
        axis=link.axis,
    )
    if dynamics == PUBLISHED_DYNAMICS:
        joint.range = (low, high)
        joint.damping[0] = link.damping
        joint.frictionloss = link.friction
        joint.solref_limit = STOP_SOLREF
        joint.solimp_limit = STOP_SOLIMP
        return
    # The wall is then met by the stop, without a contact that the solver would have to hold.
    joint.range = (low, min(high, limit))
    joint.armature = JOINT_ARMATURE
    joint.damping[0] = SLIDE_DAMPING if slide else HINGE_DAMPING
    joint.frictionloss = SLIDE_FRICTION if slide else HINGE_FRICTION


def spread_mass(body: mujoco.MjsBody, link: Link, dynamics: str) -> None:
    """Give the body of a link the mass, centre of mass and inertia that its file states, with dynamics "published"."""
    if dynamics != PUBLISHED_DYNAMICS or link.inertial is None:
        return
    body.explicitinertial = True
    body.mass = link.mass
    body.ipos = link.inertial.com
    body.fullinertia = link.inertial.inertia


def stop_at_walls(geom: mujoco.MjsGeom) -> None:
    """Turn the massless copy of a geom of a door into one that meets the walls alone (`wall_bits`), as a stop does.

    A copy, because the contact of the door with everything else is to stay as it is; without friction.
    """
    geom.contype = 0
    geom.conaffinity = contact_bits.WALL
    # Without friction: a stop of a hinge has none either.
    geom.condim = 1
    # So that its softness counts, and not a mean with that of the wall.
    geom.priority = 1
    geom.solref = STOP_SOLREF
    geom.solimp = STOP_SOLIMP


def give_stopped_weight(
    model: mujoco.MjModel, pieces: Iterable[Articulation], stopped: frozenset[str]
) -> None:
    """Give doors that meet walls an inverse weight to contacts, where MuJoCo finds none.

    MuJoCo scales the softness of a contact by the inverse weight of the bodies at their centres of mass. That of a door
    with its centre of mass on the hinge is 0: the contact with a wall becomes so hard that the solver loses its digits,
    and the door leaves the wall with up to 13 % of its speed; with a weight, with 0.3 %. It gets that of its handle.

    Args:
        model: compiled model, changed in place.
        pieces: the furniture that opens.
        stopped: ids of the links that meet walls.
    """
    links = {
        f"{piece.name}/{link.name}": link for piece in pieces for link in piece.links
    }
    # Sorted, so that the model has the same bits in every process.
    for name in sorted(stopped):
        link = links[name]
        body = model.body(name).id
        # MuJoCo has found one.
        if model.body_invweight0[body, 0] > _NO_WEIGHT:
            continue
        arm = float(np.hypot(*link.handle.pos[:2]))
        dof = model.body_dofadr[body]
        # A mean over three directions, in one of which the handle moves.
        model.body_invweight0[body, 0] = model.dof_invweight0[dof] * arm**2 / 3


def wall_bits(dynamics: str, stopped: frozenset[str]) -> int:
    """The contype of walls, for all homes of a layout: doors meet them where any home of it has a ``stopped`` one."""
    met = dynamics == PUBLISHED_DYNAMICS and bool(stopped)
    return contact_bits.STATIC | (contact_bits.WALL if met else 0)
