"""Data classes that describe packs, homes, furniture and objects, independent of any simulator.

A template is a piece of furniture that homes place. Its frame has the origin on the floor under its centre, +z up, +x
to its front (the side from which a person uses it). Lengths [m], angles [rad], masses [kg], quaternions wxyz.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

from mjhab.core.memory_cache import MemoryCache

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
IDENTITY: Quat = (1.0, 0.0, 0.0, 0.0)
PARKED: Vec3 = (0.0, 0.0, -50.0)
"""Position [m] of pieces that a home does not use: far below the floor, where nothing collides."""

OWN_POINTS = "ours"
PUBLISHED_POINTS = "published"
HANDLE_POINTS = (OWN_POINTS, PUBLISHED_POINTS)
"""Choices of handle points: the grasp point of our geometry, or the point in the plans of MS-HAB."""
OWN_DYNAMICS = "ours"
PUBLISHED_DYNAMICS = "published"
JOINT_DYNAMICS = (OWN_DYNAMICS, PUBLISHED_DYNAMICS)
"""Choices of the joints of furniture, see `layout.joints`: constants of mjhab, or what `Link` says."""
PUBLISHED_DAMPING = 0.01
"""Damping of every joint of ReplicaCAD [N s/m or N m s/rad]: ``<dynamics damping="0.01" .../>`` in all its URDFs."""
PUBLISHED_FRICTION = 0.01
"""Dry friction of every joint of ReplicaCAD [N or N m]: ``<dynamics ... friction="0.01"/>`` in all its URDFs."""

OWN_STAGE = "own"
STAND_IN = "stand-in"
NO_STAGE = "none"
OTHER_STAGE = "file"
STAGES = (OWN_STAGE, STAND_IN, NO_STAGE, OTHER_STAGE)
"""Walls of a scene: of the stage that it names; of a mesh that stands in where that is missing, fitted to the scenes
(`replica_cad.stand_in`); none; of a file that the user gave, as it is."""

Shape = Literal["box", "cylinder", "sphere", "capsule", "mesh"]


@dataclass(frozen=True)
class Geom:
    """One shape of a rigid body, for collision, rendering, or both.

    Attributes:
        shape: the kind of shape. A mesh collides as its convex hull.
        size: box: half-extents (x, y, z); cylinder and capsule: (radius, half-length along z, 0); sphere: (radius, 0,
            0); mesh: scale (x, y, z).
        pos, quat: pose in the frame of its template, link or object.
        material: name in `builtin.materials.MATERIALS`, used unless the mesh has its own colours.
        mesh: key of `Pack.meshes`, for meshes.
        collide, visual: whether it collides, and whether it is rendered.
    """

    shape: Shape
    size: Vec3
    pos: Vec3 = (0.0, 0.0, 0.0)
    quat: Quat = IDENTITY
    material: str = "plain_white"
    mesh: str = ""
    collide: bool = True
    visual: bool = True


@dataclass(frozen=True)
class Receptacle:
    """A rectangle of a surface on which objects can be placed.

    Attributes:
        name: unique within the template.
        pos: centre of the rectangle on the surface, in the frame of ``link``, or of the template if that is "".
        half: half-extents (x, y) of the rectangle.
        height: free height above it.
        kind: "open" above, inside a "drawer", or a "shelf" with something above.
        link: moving link that it is attached to; "" for none.
    """

    name: str
    pos: Vec3
    half: tuple[float, float]
    height: float
    kind: Literal["open", "drawer", "shelf"] = "open"
    link: str = ""


@dataclass(frozen=True)
class Prop:
    """Furniture without joints. ``blocks_base`` is False for rugs and mats, which robots drive over."""

    name: str
    geoms: tuple[Geom, ...]
    receptacles: tuple[Receptacle, ...] = ()
    blocks_base: bool = True


@dataclass(frozen=True)
class Handle:
    """A graspable bar on a moving link, in the frame of the link.

    Attributes:
        pos: grasp point at the middle of the bar.
        bar: unit direction along the bar.
        out: unit direction away from the front that the bar is mounted on, from which the gripper approaches.
        half_length, thickness: of the bar.
        published: handle point in the plans of MS-HAB; None if they have none.
    """

    pos: Vec3
    bar: Vec3
    out: Vec3
    half_length: float
    thickness: float
    published: Vec3 | None = None

    def point(self, points: str) -> Vec3:
        """Return the point chosen by ``points``, one of `HANDLE_POINTS`; ``pos`` if there is no published one."""
        return (
            self.published if points == PUBLISHED_POINTS and self.published else self.pos
        )


@dataclass(frozen=True)
class LinkInertial:
    """How the mass of a link is spread, in the axes of the link.

    ``com``: centre of mass in the link's frame [m]; ``inertia``: about it, xx, yy, zz, xy, xz, yz [kg m^2].
    """

    com: Vec3
    inertia: tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Link:
    """A moving part of an articulation with one joint to the static body.

    Attributes:
        name: unique within the articulation.
        joint: kind of the joint, closed at position 0 and opened by positive positions.
        axis: unit axis of the joint in the frame of the link.
        range: joint positions (closed, fully open) [m or rad].
        pos: origin of the link in the frame of the template, when closed; their axes are parallel.
        mass: [kg].
        geoms: in the frame of the link.
        handle: its handle.
        mirrored: episode files count the joint position with the opposite sign.
        damping: [N s/m or N m s/rad], friction: dry friction [N or N m] of the joint, in force with the joint dynamics
            "published". Furniture that is read from URDFs has those of its file. All other furniture stands in for
            ReplicaCAD's, and unless it says otherwise has what all joints of ReplicaCAD have.
        inertial: centre of mass and inertia that its file gives, in force with the joint dynamics "published"; None to
            compute them from the shapes, as with "ours".
    """

    name: str
    joint: Literal["slide", "hinge"]
    axis: Vec3
    range: tuple[float, float]
    pos: Vec3
    mass: float
    geoms: tuple[Geom, ...]
    handle: Handle
    mirrored: bool = False
    damping: float = PUBLISHED_DAMPING
    friction: float = PUBLISHED_FRICTION
    inertial: LinkInertial | None = None


@dataclass(frozen=True)
class FrontArea:
    """A rectangle on the floor where a robot stands to open furniture, in the furniture's frame.

    It extends from ``near_m`` to ``far_m`` along +x, out of the front, and ``half_width_m`` to both sides.
    """

    near_m: float
    far_m: float
    half_width_m: float


@dataclass(frozen=True)
class Articulation:
    """Furniture with joints: a static body (``geoms``) and links that open.

    ``front_area``: where a robot stands to open it; None for the default area in front of every drawer and door
    (`episodes.starts.fronts`).
    """

    name: str
    geoms: tuple[Geom, ...]
    links: tuple[Link, ...]
    receptacles: tuple[Receptacle, ...] = ()
    front_area: FrontArea | None = None


@dataclass(frozen=True)
class Placement:
    """Pose of a template in the world: position [m] and heading [rad] of its frame.

    ``quat``: rotation of a piece that is not upright, None for upright ones; ``yaw`` is then the heading of its x axis.
    """

    template: str
    pos: Vec3
    yaw: float = 0.0
    quat: Quat | None = None

    @property
    def rotation(self) -> Quat:
        """Quaternion wxyz of the rotation from the frame of the template to the world."""
        # Upright pieces have a heading alone, so that equal placements are equal numbers.
        return self.quat or (math.cos(self.yaw / 2), 0.0, 0.0, math.sin(self.yaw / 2))


@dataclass(frozen=True)
class Light:
    """A point light: world position [m], linear rgb, and a factor on the colour."""

    pos: Vec3
    color: Vec3 = (1.0, 0.95, 0.88)
    intensity: float = 1.0


@dataclass(frozen=True)
class Roles:
    """Assignment of furniture to the roles that tasks refer to (names in `mjhab.scenes.roles`).

    Attributes:
        places: receptacles by role, each as ``"<template>/<receptacle>"``, as ``"<template>"`` for the first receptacle
            of the template (its top), or as ``"<template>/*"`` for all of them.
        links: id ``"<articulation>/<link>"`` of a link by role.
        closed_by: id of the link that must be open to reach a receptacle that does not move with it, by receptacle
            ``"<template>/<receptacle>"``.
    """

    places: dict[str, tuple[str, ...]] = field(default_factory=dict)
    links: dict[str, str] = field(default_factory=dict)
    closed_by: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Home:
    """One furnished apartment.

    ``split``, ``macro``, ``micro``: data split, and numbers of its floor plan and of the arrangement of its furniture.
    ``walls``: boxes in the world. ``props``, ``articulations``: placed furniture, an articulation at most once.
    """

    name: str
    pack: str
    split: Literal["train", "val", "test"]
    macro: int
    micro: int
    walls: tuple[Geom, ...]
    floor: tuple[float, float, float, float]
    """Extent of the floor: x_min, y_min, x_max, y_max [m]."""
    floor_material: str
    props: tuple[Placement, ...]
    articulations: tuple[Placement, ...]
    lights: tuple[Light, ...] = ()
    floor_patches: tuple[Geom, ...] = ()
    """Thin visual-only boxes in the world: the flooring of single rooms."""
    note: str = ""
    """Remark for people, such as why the home is a hard case; "" for none."""
    open_limits: tuple[tuple[str, float], ...] = ()
    """(link id, joint position [m or rad]) of links that a wall stops before the end of their range.

    No link starts farther open. With the joint dynamics "ours" the joint ends there; with "published" it keeps its
    range, and the link meets the wall (`layout.joints`)."""
    roles: Roles | None = None
    """Roles of this home, which replace those of its pack; None for those of the pack."""


@dataclass(frozen=True)
class ObjectType:
    """A type of movable object. Its frame has the origin at the centre of the bounding box and +z up when it stands.

    ``half``: half-extents of the bounding box [m]; ``collision``: colliding geoms (primitives or convex meshes);
    ``visuals``: rendered geoms.
    """

    name: str
    mass: float
    half: Vec3
    collision: tuple[Geom, ...]
    visuals: tuple[Geom, ...]
    scan_yaw: float = 0.0
    """Heading [rad] of the scan's x axis in this frame; HAB episodes have poses of the scan's frame."""
    grasp_shape: Literal["", "mesh"] = ""
    """How grasps are generated: "" from the primitive that the object collides as (several geoms: a bowl), "mesh" by
    sampling the surface of its collision geoms."""


@dataclass(frozen=True)
class Pack:
    """An asset pack: templates by name, homes, objects by name, meshes, and roles of the furniture."""

    name: str
    props: dict[str, Prop]
    articulations: dict[str, Articulation]
    homes: tuple[Home, ...]
    objects: dict[str, ObjectType]
    meshes: dict[str, object] = field(default_factory=dict)
    """The meshes (``scenes.shapes.meshes.Mesh``) of the geoms, by name."""
    roles: Roles = Roles()
    """Roles of the furniture, in every home that has none of its own."""
    stage: str = ""
    """Where the walls of ReplicaCAD's homes come from, one of `STAGES`; "" for other homes. "stand-in" or
    "none" if any of the homes lacks its own."""

    @cached_property
    def derived(self) -> MemoryCache:
        """Cache of data computed from its homes."""
        return MemoryCache("maps")

    @cached_property
    def homes_by_name(self) -> dict[str, Home]:
        """The homes by name."""
        return {home.name: home for home in self.homes}
