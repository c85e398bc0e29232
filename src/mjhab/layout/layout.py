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

from mjhab.core.errors import unknown_name
from mjhab.core.memory_cache import MemoryCache
from mjhab.core.names import copy_names
from mjhab.layout.joints import (
    stopped_links,
)
from mjhab.robots.registry import robot_named
from mjhab.robots.robot import Robot
from mjhab.scenes.spec import (
    IDENTITY,
    JOINT_DYNAMICS,
    OWN_DYNAMICS,
    PARKED,
    Articulation,
    Home,
    Link,
    ObjectType,
    Pack,
    Placement,
    Quat,
    Vec3,
)

PARK_ORIGIN = (40.0, 40.0)
"""Position x, y [m] where slot 0 is parked if an episode does not use it; slot i lies 0.5 i m further along x."""
PARKED_TOLERANCE_M = 0.1
"""An object nearer than this [m] to its parked place is not used: what is parked moves by less while things settle."""


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
    # MuJoCo's own arithmetic, so that poses have the bits of those in the model.
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
            # The largest number of copies that any home has, by template.
            copies |= Counter(p.template for p in home.props)
        self.prop_slots = tuple(
            PropSlot(f"{name}_{k}", name, k)
            # Sorted and not as met: the order of the slots must not depend on the order of the homes.
            for name in sorted(copies)
            for k in range(copies[name])
        )
        # Spare walls are parked; a model with fewer geoms could not share a batch with the others.
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
    def stage(self) -> str:
        """`Pack.stage`: where the walls of the homes come from; "" for homes without stages."""
        return self.pack.stage

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
        # Standing on the floor, where they go to sleep and cost nothing.
        poses[:, 2] = [kind.half[2] for kind in self.objects]
        poses[:, 3] = 1.0
        return poses

    def used_slots(self, object_pose: np.ndarray) -> np.ndarray:
        """(N,) bool: which object slots an episode uses, of its poses (N, 7); the others are at `parked_poses`."""
        apart = np.abs(object_pose[:, :2] - self.parked_poses[:, :2])
        return apart.max(axis=1) > PARKED_TOLERANCE_M

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
