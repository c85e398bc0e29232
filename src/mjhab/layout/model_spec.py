"""The MuJoCo model of one home of a layout: robot, walls, furniture, objects, sensors."""

from __future__ import annotations

import functools

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.layout.contact_sensors import (
    add_depth_sensor,
    add_force_sensor,
    add_touch_sensor,
)
from mjhab.layout.joints import add_joint, spread_mass, stop_at_walls, wall_bits
from mjhab.layout.layout import Layout, compose
from mjhab.robots.model import add_robot, physics_options
from mjhab.scenes import contact_bits
from mjhab.scenes.spec import (
    IDENTITY,
    PARKED,
    PUBLISHED_DYNAMICS,
    Articulation,
    Geom,
    Home,
    ObjectType,
    Placement,
)

_GEOM_TYPE = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}
SLIDING_FRICTION = 0.3
"""Sliding friction coefficient of all geoms but the finger pads (ManiSkill's default material). MuJoCo takes the larger
one of a pair, which are equal here."""
OBJECT_FRICTION = (SLIDING_FRICTION, 0.01, 0.003)
"""Friction of objects: sliding, torsional [m], rolling [m]. Rolling friction lets round objects come to rest."""


def build_spec(layout: Layout, home: Home) -> mujoco.MjSpec:
    """Build the MjSpec of one home of a layout: robot, walls, furniture, objects, sensors."""
    spec = mujoco.MjSpec()
    spec.modelname = home.name
    # Room for the contacts of a pile; it is only reserved.
    spec.memory = 64 << 20
    physics_options(spec)
    spec.default.geom.friction[0] = SLIDING_FRICTION
    world = spec.worldbody
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    world.add_geom(
        name="floor",
        type=plane,
        size=[0, 0, 1],
        contype=contact_bits.STATIC,
        # Whatever stands still meets what moves by the affinity of the latter alone.
        conaffinity=0,
    )
    _add_meshes(spec, layout)
    add_robot(spec, layout.robot)
    for k in range(layout.num_walls):
        wall = (
            home.walls[k]
            if k < len(home.walls)
            # Small and far below: a geom cannot be left out, since all homes have one layout.
            else Geom("box", (0.01, 0.01, 0.01), PARKED)
        )
        bits = wall_bits(layout.joint_dynamics, layout.stopped_links)
        _add_geom(world, wall, f"wall_{k}", bits)
    for slot, placement in zip(
        layout.prop_slots, layout.slot_placements(home), strict=True
    ):
        prop = layout.pack.props[slot.template]
        # A base drives over rugs; objects still lie on them.
        bit = contact_bits.STATIC if prop.blocks_base else contact_bits.RUG
        _add_static(world, prop.geoms, slot.name, placement, bit)
    for articulation in layout.articulations:
        at = layout.articulation_placement(home, articulation.name)
        _add_articulation(spec, layout, articulation, at, dict(home.open_limits))
    for name, kind, pose in zip(
        layout.object_names, layout.objects, layout.parked_poses, strict=True
    ):
        _add_object(spec, name, kind, pose)
    _add_sensors(spec, layout)
    return spec


def _add_meshes(spec: mujoco.MjSpec, layout: Layout) -> None:
    pack = layout.pack
    used = {g for kind in pack.objects.values() for g in kind.collision}
    for furniture in (*pack.props.values(), *pack.articulations.values()):
        used |= {g for g in furniture.geoms if g.collide}
    scaled = {_mesh_name(g): g for g in used if g.shape == "mesh"}
    # Sorted: the order of a set differs between processes, and with it the model.
    for name in sorted(scaled):
        geom = scaled[name]
        vertices = np.asarray(pack.meshes[geom.mesh].vertices, float)  # type: ignore[attr-defined]
        spec.add_mesh(name=name, uservert=(vertices * np.array(geom.size)).ravel())


def _mesh_name(geom: Geom) -> str:
    """Name in the model of the mesh of a geom; each scale of a mesh is one of its own."""
    if geom.size == (1.0, 1.0, 1.0):
        return geom.mesh
    return f"{geom.mesh} x {geom.size}"


def _add_geom(
    body: mujoco.MjsBody,
    geom: Geom,
    name: str,
    contype: int,
    *,
    conaffinity: int = 0,
    density: float = 1000.0,
) -> mujoco.MjsGeom:
    added = body.add_geom(
        name=name,
        type=_GEOM_TYPE[geom.shape],
        pos=geom.pos,
        quat=geom.quat,
        contype=contype,
        conaffinity=conaffinity,
        density=density,
    )
    if geom.shape == "mesh":
        added.meshname = _mesh_name(geom)
    else:
        added.size = geom.size
    return added


def _add_static(
    world: mujoco.MjsBody,
    geoms: tuple[Geom, ...],
    name: str,
    at: Placement | None,
    bit: int,
) -> None:
    for i, geom in enumerate(g for g in geoms if g.collide):
        pos, quat = (
            (PARKED, IDENTITY)
            if at is None
            else compose(at.pos, at.rotation, geom.pos, geom.quat)
        )
        moved = Geom(geom.shape, geom.size, pos, quat, mesh=geom.mesh)
        _add_geom(world, moved, f"{name}/{i}", bit)


def _add_articulation(
    spec: mujoco.MjSpec,
    layout: Layout,
    articulation: Articulation,
    at: Placement,
    limits: dict[str, float],
) -> None:
    _add_static(
        spec.worldbody, articulation.geoms, articulation.name, at, contact_bits.STATIC
    )
    for link in articulation.links:
        pos, quat = compose(at.pos, at.rotation, link.pos)
        name = f"{articulation.name}/{link.name}"
        # In the world and not below a body of the furniture: what stands still is fused with the world's body.
        body = spec.worldbody.add_body(name=name, pos=pos, quat=quat)
        add_joint(body, name, link, layout.joint_dynamics, limits.get(name, np.inf))
        spread_mass(body, link, layout.joint_dynamics)
        stopped = name in layout.stopped_links
        met = layout.joint_dynamics == PUBLISHED_DYNAMICS and stopped
        solid = [g for g in link.geoms if g.collide]
        # One density for all geoms gives the mass of the file, spread by volume.
        density = link.mass / ordered_sum(volume(g, None) for g in solid)
        for i, geom in enumerate(solid):
            _add_geom(body, geom, f"{name}/{i}", contact_bits.JOINTED, density=density)
            if met:
                stop_at_walls(_add_geom(body, geom, f"{name}/{i}/wall", 0, density=0.0))


def _add_object(
    spec: mujoco.MjSpec, name: str, kind: ObjectType, pose: np.ndarray
) -> None:
    body = spec.worldbody.add_body(name=name, pos=pose[:3], quat=pose[3:])
    body.add_freejoint(name=name)
    affinity = contact_bits.OBJECT_AFFINITY
    # A bowl has 24 pieces of two meshes.
    pieces = {_mesh_name(g): g for g in kind.collision if g.shape == "mesh"}
    of_mesh = {mesh: volume(piece, spec) for mesh, piece in pieces.items()}
    density = kind.mass / ordered_sum(
        of_mesh[_mesh_name(g)] if g.shape == "mesh" else volume(g, spec)
        for g in kind.collision
    )
    for i, geom in enumerate(kind.collision):
        added = _add_geom(
            body,
            geom,
            f"{name}/{i}",
            contact_bits.OBJECT,
            conaffinity=affinity,
            density=density,
        )
        # With rolling friction, so that cans come to rest and sleep.
        added.condim = 6
        added.friction = OBJECT_FRICTION


def volume(geom: Geom, spec: mujoco.MjSpec | None) -> float:
    """Return the volume of a collision geom [m^3]; that of a mesh is the volume of its convex hull.

    Args:
        geom: the geom; sizes [m] as in MuJoCo.
        spec: holds the meshes; None if only primitives are allowed.

    Raises:
        ValueError: ``geom`` is a mesh and ``spec`` is None.
    """
    x, y, z = geom.size
    if geom.shape == "box":
        return 8 * x * y * z
    if geom.shape == "cylinder":
        return 2 * np.pi * x * x * y
    if geom.shape == "sphere":
        return 4 / 3 * np.pi * x**3
    if geom.shape == "capsule":
        return np.pi * x * x * (2 * y + 4 / 3 * x)
    if spec is None:
        raise ValueError(
            f"links of articulations are made of primitives, got mesh {geom.mesh!r}"
        )
    vertices = np.asarray(spec.mesh(_mesh_name(geom)).uservert, np.float64)
    return _hull_volume(vertices.tobytes())


@functools.lru_cache(maxsize=64)
def _hull_volume(vertices: bytes) -> float:
    """Volume [m^3] of the convex hull of float64 vertices (V, 3); all homes of a layout have the same objects."""
    return float(ConvexHull(np.frombuffer(vertices).reshape(-1, 3)).volume)


def _add_sensors(spec: mujoco.MjSpec, layout: Layout) -> None:
    robot = layout.robot
    targets = (*layout.object_names, *layout.link_ids)
    for link in robot.force_links:
        add_force_sensor(spec, f"force/{link}", link)
    for link in (*robot.finger_links, robot.tcp):
        add_force_sensor(spec, f"hand/{link}", link)
    for target in targets:
        add_touch_sensor(spec, f"touch>{target}", robot.base_link, target)
    add_depth_sensor(spec, "robot_depth", robot.base_link)
    # Object type XBODY measures at the origin of the link frame, BODY at its centre of mass.
    linvel = mujoco.mjtSensor.mjSENS_FRAMELINVEL
    xbody = mujoco.mjtObj.mjOBJ_XBODY
    spec.add_sensor(name="tcp_velocity", type=linvel, objtype=xbody, objname=robot.tcp)
