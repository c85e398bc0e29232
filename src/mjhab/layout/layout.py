"""One layout for all homes of a pack, one MjModel per home.

Every home compiles to a model of the same sizes and order: the union of all furniture and walls of the pack's homes,
and the objects of the roster. Furniture that a home lacks is parked below the floor. Homes differ only in static poses,
wall sizes and joint ranges, so that any world of a batch can be in any home.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.errors import unknown_name
from mjhab.core.memory_cache import MemoryCache
from mjhab.core.names import copy_names
from mjhab.layout.contact_sensors import (
    add_depth_sensor,
    add_force_sensor,
    add_touch_sensor,
)
from mjhab.layout.joints import (
    add_joint,
    spread_mass,
    stop_at_walls,
    stopped_links,
    wall_bits,
)
from mjhab.robots.model import add_robot, physics_options
from mjhab.robots.registry import robot_named
from mjhab.robots.robot import Robot
from mjhab.scenes import contact_bits
from mjhab.scenes.spec import (
    IDENTITY,
    JOINT_DYNAMICS,
    OWN_DYNAMICS,
    PARKED,
    PUBLISHED_DYNAMICS,
    Articulation,
    Geom,
    Home,
    Link,
    ObjectType,
    Pack,
    Placement,
    Quat,
    Vec3,
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
PARK_ORIGIN = (40.0, 40.0)
"""Position x, y [m] where slot 0 is parked if an episode does not use it; slot i lies 0.5 i m further along x."""


def yaw_quat(yaw: float) -> Quat:
    """Return the quaternion (wxyz) of a rotation by ``yaw`` [rad] about +z."""
    return (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))


def compose(
    pos: Vec3, quat: Quat, local_pos: Vec3, local_quat: Quat = IDENTITY
) -> tuple[Vec3, Quat]:
    """Return the world pose of a child frame from the world pose of its parent and its pose in the parent's frame.

    Args:
        pos: world position of the parent [m].
        quat: world orientation of the parent, wxyz.
        local_pos: position of the child in the parent's frame [m].
        local_quat: orientation of the child in the parent's frame, wxyz.

    Returns:
        World position [m] and orientation (wxyz) of the child.
    """
    out_pos = np.zeros(3)
    out_quat = np.zeros(4)
    mujoco.mju_rotVecQuat(out_pos, np.asarray(local_pos, float), np.asarray(quat, float))
    mujoco.mju_mulQuat(out_quat, np.asarray(quat, float), np.asarray(local_quat, float))
    out_pos += pos
    x, y, z = out_pos.tolist()
    qw, qx, qy, qz = out_quat.tolist()
    return (x, y, z), (qw, qx, qy, qz)


@dataclass(frozen=True)
class PropSlot:
    """Slot of the layout for copy ``index`` of a prop template; ``name`` is ``<template>_<index>``."""

    name: str
    template: str
    index: int


@dataclass(frozen=True)
class LinkRef:
    """A moving link of an articulation; ``id`` is ``<articulation>/<link>``."""

    id: str
    articulation: str
    link: Link


class Layout:
    """Names, order and sizes shared by the models of all homes of a pack, for one robot and one object roster.

    Args:
        pack: the asset pack.
        roster: object type of each of the N object slots.
        robot: the robot; None for the default robot.
        joint_dynamics: of the furniture, one of `spec.JOINT_DYNAMICS`, see `layout.joints`.

    Raises:
        UsageError: the pack lacks an object type of the roster, or the joint dynamics are unknown.

    Attributes:
        prop_slots: slots of the fixed furniture: of each template as many as the home with the most copies has.
        num_walls: walls of the home with the most walls.
        articulations: furniture with moving links, by name.
        links: the L moving links, grouped by articulation.
        link_ids: their ids, ``<articulation>/<link>``.
        object_names: (N,) names of the object slots.
        objects: (N,) their object types.
    """

    def __init__(
        self,
        pack: Pack,
        roster: tuple[str, ...],
        robot: Robot | None = None,
        joint_dynamics: str = OWN_DYNAMICS,
    ) -> None:
        if joint_dynamics not in JOINT_DYNAMICS:
            raise unknown_name("joint dynamics", joint_dynamics, JOINT_DYNAMICS)
        self.pack = pack
        self.joint_dynamics = joint_dynamics
        self.roster = roster
        self.robot = robot or robot_named()
        copies: Counter[str] = Counter()
        for home in pack.homes:
            copies |= Counter(p.template for p in home.props)
        self.prop_slots = tuple(
            PropSlot(f"{name}_{k}", name, k)
            for name in sorted(copies)
            for k in range(copies[name])
        )
        self.num_walls = max(len(home.walls) for home in pack.homes)
        self.articulations: tuple[Articulation, ...] = tuple(
            pack.articulations[n] for n in sorted(pack.articulations)
        )
        self.links = tuple(
            LinkRef(f"{a.name}/{k.name}", a.name, k)
            for a in self.articulations
            for k in a.links
        )
        self.link_ids = tuple(ref.id for ref in self.links)
        self.doors = frozenset(ref.id for ref in self.links if ref.link.joint == "hinge")
        """Ids of the links with a hinge joint; the others have a slide joint."""
        self.stopped_links = stopped_links(pack.homes)
        """Ids of the links that a wall stops in one of the homes."""
        self.object_names = copy_names(roster)
        for kind in roster:
            if kind not in pack.objects:
                raise unknown_name(
                    f"object type of pack {pack.name!r}", kind, pack.objects
                )
        self.objects: tuple[ObjectType, ...] = tuple(
            pack.objects[kind] for kind in roster
        )
        self.derived = MemoryCache("maps")
        """Cache of data computed from the homes, by key."""

    @property
    def num_objects(self) -> int:
        """Number of object slots N."""
        return len(self.roster)

    @cached_property
    def parked_poses(self) -> np.ndarray:
        """(N, 7) world poses [m, wxyz] of object slots that an episode does not use, see PARK_ORIGIN."""
        poses = np.zeros((self.num_objects, 7))
        poses[:, 0] = PARK_ORIGIN[0] + 0.5 * np.arange(self.num_objects)
        poses[:, 1] = PARK_ORIGIN[1]
        poses[:, 2] = [kind.half[2] for kind in self.objects]
        poses[:, 3] = 1.0
        return poses

    def slot_placements(self, home: Home) -> list[Placement | None]:
        """Return the placement of every prop slot in a home; None for slots that the home does not use."""
        left: dict[str, list[Placement]] = {}
        for placement in home.props:
            left.setdefault(placement.template, []).append(placement)
        return [
            left[s.template][s.index] if s.index < len(left.get(s.template, ())) else None
            for s in self.prop_slots
        ]

    def articulation_placement(self, home: Home, name: str) -> Placement:
        """Return the placement of an articulation in a home; parked below the floor if the home lacks it."""
        return next(
            (p for p in home.articulations if p.template == name), Placement(name, PARKED)
        )

    def closed_link_origin(self, home: Home, link_id: str) -> Vec3:
        """Return the world position [m] of the origin of a moving link in its closed position."""
        ref = self.links[self.link_ids.index(link_id)]
        at = self.articulation_placement(home, ref.articulation)
        return compose(at.pos, at.rotation, ref.link.pos)[0]

    def closed_handle(self, home: Home, link_id: str) -> Vec3:
        """Return the world position [m] of the grasp point of a link's handle in the closed position."""
        ref = self.links[self.link_ids.index(link_id)]
        at = self.articulation_placement(home, ref.articulation)
        x, y, z = ref.link.handle.pos
        ox, oy, oz = ref.link.pos
        return compose(at.pos, at.rotation, (ox + x, oy + y, oz + z))[0]


def build_spec(layout: Layout, home: Home) -> mujoco.MjSpec:
    """Build the MjSpec of one home of a layout: robot, walls, furniture, objects, sensors."""
    spec = mujoco.MjSpec()
    spec.modelname = home.name
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
        conaffinity=0,
    )
    _add_meshes(spec, layout)
    add_robot(spec, layout.robot)
    for k in range(layout.num_walls):
        wall = (
            home.walls[k]
            if k < len(home.walls)
            else Geom("box", (0.01, 0.01, 0.01), PARKED)
        )
        bits = wall_bits(layout.joint_dynamics, layout.stopped_links)
        _add_geom(world, wall, f"wall_{k}", bits)
    for slot, placement in zip(
        layout.prop_slots, layout.slot_placements(home), strict=True
    ):
        prop = layout.pack.props[slot.template]
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
        body = spec.worldbody.add_body(name=name, pos=pos, quat=quat)
        add_joint(body, name, link, layout.joint_dynamics, limits.get(name, np.inf))
        spread_mass(body, link, layout.joint_dynamics)
        stopped = name in layout.stopped_links
        met = layout.joint_dynamics == PUBLISHED_DYNAMICS and stopped
        solid = [g for g in link.geoms if g.collide]
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
    density = kind.mass / ordered_sum(volume(g, spec) for g in kind.collision)
    for i, geom in enumerate(kind.collision):
        added = _add_geom(
            body,
            geom,
            f"{name}/{i}",
            contact_bits.OBJECT,
            conaffinity=affinity,
            density=density,
        )
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
    return float(
        ConvexHull(np.asarray(spec.mesh(_mesh_name(geom)).uservert).reshape(-1, 3)).volume
    )


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


@dataclass(frozen=True, eq=False)
class Addresses:
    """Indices into qpos, qvel, bodies and sensordata, valid for the models of all homes of a layout.

    Letters: J robot joints, N object slots, L moving links, K force links of the robot.

    Attributes:
        robot: the robot of the layout.
        robot_q: (J,) columns of qpos in the order of ``robot.joints``.
        robot_v: (J,) columns of qvel in the same order.
        object_q: (N,) first of the 7 columns of qpos of each object.
        object_v: (N,) first of the 6 columns of qvel of each object.
        object_body: (N,) body ids.
        link_q: (L,) columns of qpos.
        link_v: (L,) columns of qvel.
        link_body: (L,) body ids.
        robot_body: body id by name of the robot link.
        link_force: (K,) first column in sensordata of each force sensor, FORCE_SENSOR_WIDTH wide.
        hand_force: (3,) the same for [left finger, right finger, tcp link].
        touch: (N + L,) first column of the touch sensor of each target (objects, then links), TOUCH_SENSOR_WIDTH wide.
        tcp_velocity: first of 3 columns: velocity of the tcp in the world frame [m/s].
    """

    robot: Robot
    robot_q: np.ndarray
    robot_v: np.ndarray
    object_q: np.ndarray
    object_v: np.ndarray
    object_body: np.ndarray
    link_q: np.ndarray
    link_v: np.ndarray
    link_body: np.ndarray
    robot_body: dict[str, int]
    link_force: np.ndarray
    hand_force: np.ndarray
    touch: np.ndarray
    tcp_velocity: int


def addresses(layout: Layout, model: mujoco.MjModel) -> Addresses:
    """Look up the indices of a layout's joints, bodies and sensors in a compiled model of any of its homes."""

    def joints(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
        ids = [model.joint(n).id for n in names]
        return model.jnt_qposadr[ids].copy(), model.jnt_dofadr[ids].copy()

    def sensors(names: list[str]) -> np.ndarray:
        return np.array([model.sensor(n).adr[0] for n in names])

    robot = layout.robot
    robot_q, robot_v = joints(robot.joints)
    object_q, object_v = joints(layout.object_names)
    link_q, link_v = joints(layout.link_ids)
    targets = (*layout.object_names, *layout.link_ids)
    return Addresses(
        robot=robot,
        robot_q=robot_q,
        robot_v=robot_v,
        object_q=object_q,
        object_v=object_v,
        link_q=link_q,
        link_v=link_v,
        object_body=np.array([model.body(n).id for n in layout.object_names]),
        link_body=np.array([model.body(n).id for n in layout.link_ids]),
        robot_body={n: model.body(n).id for n in robot.model_links},
        link_force=sensors([f"force/{n}" for n in robot.force_links]),
        hand_force=sensors([f"hand/{n}" for n in (*robot.finger_links, robot.tcp)]),
        touch=sensors([f"touch>{t}" for t in targets]),
        tcp_velocity=int(model.sensor("tcp_velocity").adr[0]),
    )
