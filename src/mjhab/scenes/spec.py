"""What a home is made of: plain frozen data, before any simulator is involved.

Frames: every template has its origin on the floor under its centre, +z up, +x to its front (the side a
person stands at). Lengths [m], angles [rad], masses [kg], quaternions wxyz.
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
"""Where pieces stand that a home does not use: far below the floor, no contact possible."""

OWN_POINTS = "ours"
PUBLISHED_POINTS = "published"
HANDLE_POINTS = (OWN_POINTS, PUBLISHED_POINTS)
"""Points to show for handles: where our geometry is gripped, or those that the plans of MS-HAB name."""

Shape = Literal["box", "cylinder", "sphere", "capsule", "mesh"]


@dataclass(frozen=True)
class Geom:
    """One piece of a rigid thing, for collision, for the eye, or for both.

    ``size``: box half-extents (x, y, z); cylinder and capsule (radius, half-length along z, 0);
    sphere (radius, 0, 0); mesh: scale (x, y, z), with ``mesh`` naming an entry of ``scenes.shapes.meshes``.
    A colliding mesh is taken as its convex hull.
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
    """A box of space in which objects may stand; its floor is the supporting surface.

    ``pos`` is the centre of the *supporting rectangle* (on the surface) in the frame of the template or of
    ``link``; ``half`` the half-extents (x, y) of the usable rectangle; ``height`` the free height above it.
    """

    name: str
    pos: Vec3
    half: tuple[float, float]
    height: float
    kind: Literal["open", "drawer", "shelf"] = "open"
    link: str = ""


@dataclass(frozen=True)
class Prop:
    """Furniture without joints. ``blocks_base`` False: rugs and mats, which robots drive over."""

    name: str
    geoms: tuple[Geom, ...]
    receptacles: tuple[Receptacle, ...] = ()
    blocks_base: bool = True


@dataclass(frozen=True)
class Handle:
    """A graspable bar on a moving link, in the frame of the link.

    ``pos``: grasp point at the middle of the bar; ``bar``: unit direction of the bar; ``out``: unit
    direction pointing away from the front the bar is mounted on (from where the gripper comes). ``published``: the
    point that plans of MS-HAB name for the handle, None where there are none.
    """

    pos: Vec3
    bar: Vec3
    out: Vec3
    half_length: float
    thickness: float
    published: Vec3 | None = None

    def point(self, points: str) -> Vec3:
        """The point to show for the handle, ``points`` being one of HANDLE_POINTS."""
        return self.published if points == PUBLISHED_POINTS and self.published else self.pos


@dataclass(frozen=True)
class Link:
    """A moving part of an articulation with one joint to the static body.

    Its joint is closed at 0, the start of its ``range``, and opens upwards. ``mirrored``: files count it downwards.
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


@dataclass(frozen=True)
class FrontArea:
    """A rectangle on the floor from which furniture is opened [m], seen along +x: the direction out of the front."""

    near_m: float
    far_m: float
    half_width_m: float


@dataclass(frozen=True)
class Articulation:
    """Furniture with joints: a static body and links that open.

    ``front_area``: where a robot stands to open it, seen from the origin of its frame; None for the usual area in front
    of every drawer and door (`episodes.starts.fronts`).
    """

    name: str
    geoms: tuple[Geom, ...]
    links: tuple[Link, ...]
    receptacles: tuple[Receptacle, ...] = ()
    front_area: FrontArea | None = None


@dataclass(frozen=True)
class Placement:
    """Where a template stands: position [m] and heading [rad] of its frame.

    ``quat``: the whole rotation of a piece that does not stand upright (a bike on its stand); ``yaw`` is then the
    heading of its x axis.
    """

    template: str
    pos: Vec3
    yaw: float = 0.0
    quat: Quat | None = None

    @property
    def rotation(self) -> Quat:
        """Rotation from the frame of the template to the world."""
        return self.quat or (math.cos(self.yaw / 2), 0.0, 0.0, math.sin(self.yaw / 2))


@dataclass(frozen=True)
class Light:
    """A point light."""

    pos: Vec3
    color: Vec3 = (1.0, 0.95, 0.88)
    intensity: float = 1.0


@dataclass(frozen=True)
class Roles:
    """Which pieces of furniture play the roles that tasks ask for (names in `mjhab.scenes.roles`).

    ``places``: role to the receptacles that play it, each as ``"<template>/<receptacle>"``, as ``"<template>"`` for the
    first receptacle of every such piece (its top), or as ``"<template>/*"`` for all of them. ``links``: role to the id
    ``"<articulation>/<link>"`` of the link that plays it. ``closed_by``: receptacle ``"<template>/<receptacle>"`` to
    the id of the link that must be open to reach it, where it does not move with that link.
    """

    places: dict[str, tuple[str, ...]] = field(default_factory=dict)
    links: dict[str, str] = field(default_factory=dict)
    closed_by: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Home:
    """One furnished apartment. ``walls`` are boxes in world coordinates (collide and block the base)."""

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
    """Visual-only thin boxes that give rooms their own flooring."""
    note: str = ""
    """What a person should know about this home: a hard case, or empty."""
    open_limits: tuple[tuple[str, float], ...] = ()
    """(link id, joint position [m] or [rad]) of links that meet a wall before the end of their range."""
    roles: Roles | None = None
    """Roles that hold in this home instead of those of its pack; None for those of the pack."""


@dataclass(frozen=True)
class ObjectType:
    """A movable object. Frame: origin at the centre of the bounding box, +z up when it stands.

    ``half``: half-extents of the bounding box [m]; ``collision`` geoms (primitives or convex meshes);
    ``visuals`` geoms for the eye only.
    """

    name: str
    mass: float
    half: Vec3
    collision: tuple[Geom, ...]
    visuals: tuple[Geom, ...]
    scan_yaw: float = 0.0
    """Heading [rad] in this frame of the x axis of the scan; HAB episodes give poses in the axes of the scan."""
    grasp_shape: Literal["", "mesh"] = ""
    """How grasps are found: "" by the primitive that the collision geoms are (several of them make a bowl), "mesh"
    on the surface of the collision geoms, whatever shape they have."""


@dataclass(frozen=True)
class Pack:
    """An asset pack: templates, homes, objects, and which pieces play which roles."""

    name: str
    props: dict[str, Prop]
    articulations: dict[str, Articulation]
    homes: tuple[Home, ...]
    objects: dict[str, ObjectType]
    meshes: dict[str, object] = field(default_factory=dict)
    """Name to ``scenes.shapes.meshes.Mesh`` for every mesh the geoms name."""
    roles: Roles = Roles()
    """Which pieces play the roles that tasks ask for, in every home that states none of its own."""

    @cached_property
    def derived(self) -> MemoryCache:
        """What is computed from its homes; the keys say what."""
        return MemoryCache("maps")

    @cached_property
    def homes_by_name(self) -> dict[str, Home]:
        """The homes under their names."""
        return {home.name: home for home in self.homes}
