"""What mjhab knows about a robot. Everything that names or numbers a joint, a link or a camera takes it from a `Robot`.

A robot is a mobile manipulator: a base that moves in the plane by three joints, an arm with a parallel gripper and,
where it has them, a torso that lifts the arm and a head. `robots.registry` finds robots by name.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.joints import BASE, GROUPS, JointColumns
from mjhab.robots.body_check import BodyNeeds, check_body
from mjhab.robots.kinematics import Chain, ChainRoot
from mjhab.robots.parts import (
    ActionColumns,
    ActionLimits,
    Body,
    CameraMount,
    Finger,
    Gains,
    Gripper,
)
from mjhab.scenes.builtin.materials import Material
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import Vec3

Visuals = Callable[[], list[tuple[str, Mesh, str]]]
"""Function that gives the visual meshes: (body, mesh in the frame of that body [m], name of its material)."""


@dataclass(frozen=True)
class Footprint:
    """Room that a base needs on the floor: radii [m] of discs, and its height ``top`` [m].

    ``radius``: the disc that covers the base. ``spawn``: free around every start. ``wide``, ``narrow``: the scripted
    experts plan ways with the first and squeeze through passages with the second.
    """

    radius: float
    spawn: float
    wide: float
    narrow: float
    top: float


@dataclass(frozen=True)
class ArmReach:
    """How far an arm reaches, as the scripted experts estimate it before they solve inverse kinematics. Lengths [m].

    The first joint of the arm stands ``ahead`` of the centre of the base, the second one ``out`` from its axis, at
    heights from ``low`` to ``high``, depending on the torso. From the second joint to the wrist it is ``length``
    comfortably, from the wrist to the tool centre ``hand``. ``level``: least and greatest workable distance of the hand
    from the second joint, seen from above.
    """

    ahead: float
    out: float
    low: float
    high: float
    length: float
    hand: float
    level: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Robot:
    """A mobile manipulator.

    Attributes:
        name: what ``mjhab.make(robot=...)`` calls it.
        joints: names of the joints in the order of joint positions: base, posture, fingers (`core.joints`).
        groups: names of the joints of every group of GROUPS that the robot has. The order within "arm" and "head" is
            that of actions; "base" is x, y, yaw; "fingers" are two joints that open at positive values [m].
        load_body: reads links, masses and collision shapes; called once, when they are first needed.
        rest_qpos: (J,) joint positions at rest [m, rad].
        base_link: link that the joints of the base move. base_height: its height above the floor [m]: it floats.
        arm_root: link whose frame end-effector actions are given in; base and torso carry it along.
        tcp: link whose origin is the tool centre, x along the fingers, y the line on which they close.
        fingers: left and right finger; empty for a robot without a gripper.
        force_links: links whose contact forces add up to ``robot_force``: all with collision shapes but the fingers.
        trunk_links, distal_links: links of the second kind collide with those of the first. Other pairs of links of
            the robot do not collide.
        cameras: its cameras, that of the head first.
        gains: servos of every group of joints. stiff_gains: torso and head under a stiff control mode.
        limits: what an action of ±1 means.
        gripper: sizes of hand and fingers.
        ee_rest_pos: where success wants the tool centre at rest, in the frame of base_link [m]; None for where
            ``rest_qpos`` brings it.
        arm_links: links that keep clear of furniture where the hand works: those of the arm without the last ones, and
            what the torso carries. wrist_links: the last ones before the hand.
        footprint, reach: room that base and arm need.
        elbow: joint of the arm at whose zero the arm is stretched.
        visuals: its meshes. materials: their materials.
    """

    name: str
    joints: tuple[str, ...]
    groups: Mapping[str, tuple[str, ...]]
    load_body: Callable[[], Body]
    rest_qpos: tuple[float, ...]
    base_link: str
    base_height: float
    arm_root: str
    tcp: str
    fingers: tuple[Finger, ...]
    force_links: tuple[str, ...]
    trunk_links: tuple[str, ...]
    distal_links: tuple[str, ...]
    arm_links: tuple[str, ...]
    wrist_links: tuple[str, ...]
    cameras: tuple[CameraMount, ...]
    gains: Mapping[str, Gains]
    stiff_gains: Gains
    gripper: Gripper
    footprint: Footprint
    reach: ArmReach
    elbow: str
    visuals: Visuals
    ee_rest_pos: Vec3 | None = None
    limits: ActionLimits = field(default_factory=ActionLimits)
    materials: Mapping[str, Material] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for group in self.groups:
            if group not in GROUPS:
                raise UsageError(
                    f"robot {self.name!r}: {unknown_name('joint group', group, GROUPS)}"
                )
        named = sorted(joint for group in self.groups.values() for joint in group)
        if named != sorted(self.joints):
            odd = sorted(set(named) ^ set(self.joints)) or "a joint that is in two groups"
            raise UsageError(
                f"robot {self.name!r}: every joint belongs to one group; look at {odd}."
            )
        if self.joints[BASE] != self.group("base") or len(self.group("base")) != BASE.stop:
            raise UsageError(
                f"robot {self.name!r}: the first three joints must be group 'base' (x, y, yaw), got "
                f"{self.joints[BASE]} and group {self.group('base')}."
            )
        fingers = set(self.group("fingers"))
        if set(self.joints[len(self.joints) - len(fingers) :]) != fingers:
            raise UsageError(
                f"robot {self.name!r}: the joints of group 'fingers' must be the last."
            )
        if len(self.rest_qpos) != len(self.joints):
            raise UsageError(
                f"robot {self.name!r}: rest_qpos needs {len(self.joints)} values, one per joint, got "
                f"{len(self.rest_qpos)}."
            )
        self._check_gains()
        self._check_cameras()

    def _check_gains(self) -> None:
        lacking = [g for g in GROUPS if self.group(g) and g not in self.gains]
        if lacking:
            raise UsageError(
                f"robot {self.name!r}: gains lack group {' and '.join(map(repr, lacking))}; every group needs a Gains; "
                f"given are: {', '.join(self.gains) or 'none'}."
            )
        for group, gains in (*self.gains.items(), ("stiff_gains", self.stiff_gains)):
            if not isinstance(gains, Gains):
                raise UsageError(
                    f"robot {self.name!r}: gains of {group!r} must be a Gains, got {type(gains).__name__}."
                )
        arm = self.group("arm")
        if arm and self.elbow not in arm:
            raise UsageError(
                f"robot {self.name!r}: elbow: {unknown_name('joint of the arm', self.elbow, arm)}"
            )

    def _check_cameras(self) -> None:
        for k, camera in enumerate(self.cameras):
            if not isinstance(camera, CameraMount):
                raise UsageError(
                    f"robot {self.name!r}: cameras[{k}] must be a CameraMount, got {type(camera).__name__}."
                )
            if camera.name in self.camera_names[:k]:
                raise UsageError(f"robot {self.name!r}: two cameras are called {camera.name!r}.")
            if not 0.0 < camera.fovy < np.pi:
                raise UsageError(
                    f"robot {self.name!r}: fovy of camera {camera.name!r} must be between 0 and pi [rad], got "
                    f"{camera.fovy:g}."
                )

    # -- joints ----------------------------------------------------------------------------------------------------

    def group(self, name: str) -> tuple[str, ...]:
        """Names of the joints of a group; empty where the robot has none of it."""
        if name not in GROUPS:
            raise unknown_name("joint group", name, GROUPS)
        return tuple(self.groups.get(name, ()))

    def require(self, groups: Iterable[str], purpose: str) -> None:
        """Check that the robot has some groups of joints.

        Raises:
            UsageError: it lacks one; the message says which and for what ``purpose`` it is needed.
        """
        missing = [group for group in groups if not self.group(group)]
        if missing:
            raise UsageError(
                f"robot {self.name!r} has no joint group {' and no '.join(map(repr, missing))}, which {purpose} needs; "
                f"it has: {', '.join(g for g in GROUPS if self.group(g))}."
            )

    def columns_of(self, joints: Iterable[str]) -> tuple[int, ...]:
        """Columns of joints in arrays of joint positions.

        Raises:
            UsageError: a joint that the robot does not have.
        """
        found = []
        for joint in joints:
            if joint not in self.joints:
                raise unknown_name("joint", joint, self.joints)
            found.append(self.joints.index(joint))
        return tuple(found)

    @cached_property
    def body_joints(self) -> tuple[str, ...]:
        """Head, then torso: the joints that follow the gripper in an action."""
        return (*self.group("head"), *self.group("torso"))

    @cached_property
    def arm_columns(self) -> tuple[int, ...]:
        """Columns of the arm, in the order of actions."""
        return self.columns_of(self.group("arm"))

    @cached_property
    def head_columns(self) -> tuple[int, ...]:
        """Columns of the head, in the order of actions."""
        return self.columns_of(self.group("head"))

    @cached_property
    def torso_columns(self) -> tuple[int, ...]:
        """Columns of the torso."""
        return self.columns_of(self.group("torso"))

    @cached_property
    def body_columns(self) -> tuple[int, ...]:
        """Columns of head and torso, in the order of actions."""
        return self.columns_of(self.body_joints)

    @cached_property
    def finger_columns(self) -> tuple[int, ...]:
        """Columns of the fingers."""
        return self.columns_of(self.group("fingers"))

    @cached_property
    def elbow_column(self) -> int:
        """Column of the elbow."""
        return self.columns_of((self.elbow,))[0]

    @cached_property
    def columns(self) -> JointColumns:
        """Where base, posture and fingers are."""
        count = len(self.joints)
        torso = self.torso_columns
        return JointColumns(
            count=count,
            fingers=slice(count - len(self.group("fingers")), count),
            torso=torso[0] if torso else None,
        )

    @cached_property
    def action(self) -> ActionColumns:
        """Columns of an action of the default control mode."""
        gripper = len(self.group("arm"))
        torso = gripper + 1 + len(self.group("head"))
        base = torso + len(self.group("torso"))
        return ActionColumns(
            arm=slice(0, gripper),
            gripper=gripper,
            body=slice(gripper + 1, base),
            head=tuple(range(gripper + 1, torso)),
            torso=tuple(range(torso, base)),
            base_forward=base,
            base_yaw=base + 1,
        )

    @cached_property
    def joint_limits(self) -> tuple[tuple[float, float], ...]:
        """(low, high) of every joint [m or rad]; infinite where it turns freely."""
        limits = {row.joint: row.limits for row in self.body.tree if row.joint}
        base = dict(zip(self.group("base"), BASE_LIMITS, strict=True))
        return tuple((limits | base)[joint] for joint in self.joints)

    @cached_property
    def finger_max(self) -> float:
        """Position [m] of a finger that is wide open."""
        return self.joint_limits[self.finger_columns[0]][1]

    @cached_property
    def sliding(self) -> frozenset[str]:
        """Names of the joints that move along a line; positions of the others are angles."""
        slides = {row.joint for row in self.body.tree if row.joint and row.slide}
        return frozenset(slides | set(self.group("base")[:2]))

    @cached_property
    def gains_of(self) -> dict[str, Gains]:
        """Servo of every joint."""
        return {joint: self.gains[group] for group in self.groups for joint in self.group(group)}

    # -- links -----------------------------------------------------------------------------------------------------

    @cached_property
    def body(self) -> Body:
        """Links, masses and collision shapes.

        Raises:
            UsageError: ``load_body`` gives links that do not fit the other fields, see `check_body`.
        """
        upper = range(BASE.stop, len(self.joints))
        needs = BodyNeeds(
            robot=self.name,
            base_link=self.base_link,
            links={
                "tcp": (self.tcp,),
                "arm_root": (self.arm_root,),
                "trunk_links": self.trunk_links,
                "distal_links": self.distal_links,
                "arm_links": self.arm_links,
                "wrist_links": self.wrist_links,
                **{f"body of camera {c.name!r}": (c.body,) for c in self.cameras},
            },
            bodies={"force_links": self.force_links, "fingers": self.finger_links},
            rest={self.joints[j]: self.rest_qpos[j] for j in upper},
        )
        return check_body(self.load_body(), needs)

    @cached_property
    def links(self) -> tuple[str, ...]:
        """Links that are bodies of the model: those with collision shapes. Others merge into their parents."""
        return tuple(self.body.collision)

    @property
    def finger_links(self) -> tuple[str, ...]:
        """Links of the left and the right finger."""
        return tuple(finger.link for finger in self.fingers)

    @property
    def model_links(self) -> tuple[str, ...]:
        """Links whose poses and forces are read: those whose force counts, the fingers and the tool centre."""
        return tuple(dict.fromkeys((*self.force_links, *self.finger_links, self.tcp)))

    @property
    def hand_links(self) -> tuple[str, ...]:
        """The end effector: the link of the tool centre and the fingers."""
        return (self.tcp, *self.finger_links)

    @cached_property
    def arm_force_rows(self) -> tuple[int, ...]:
        """Which of ``force_links`` are no part of the trunk."""
        rows = enumerate(self.force_links)
        return tuple(row for row, link in rows if link not in self.trunk_links)

    @cached_property
    def rest(self) -> np.ndarray:
        """(J,) joint positions at rest, as an array that must not be written to."""
        rest = np.array(self.rest_qpos, dtype=np.float64)
        rest.flags.writeable = False
        return rest

    @cached_property
    def tool_at_rest(self) -> Vec3:
        """Where success wants the tool centre at rest, in the frame of base_link [m]."""
        if self.ee_rest_pos is not None:
            return self.ee_rest_pos
        x, y, z = self.chain.tip_pose(self.rest)[0][0]
        return (float(x), float(y), float(z) - self.base_height)

    @cached_property
    def chain(self) -> Chain:
        """The links from the base to the tool centre; columns are all joints."""
        return self.chain_with(())

    def chain_with(self, links: Iterable[str]) -> Chain:
        """`chain` with more links."""
        return Chain.from_tree(
            self.body.tree,
            self.joints,
            tip=self.tcp,
            root=ChainRoot(self.base_link, self.base_height),
            extra=tuple(links),
            groups=self.groups,
        )

    @cached_property
    def arm_chain(self) -> Chain:
        """The arm from ``arm_root`` to the tool centre; columns are the joints of the arm in action order."""
        return Chain.from_tree(
            self.body.tree,
            self.group("arm"),
            tip=self.tcp,
            root=ChainRoot(self.arm_root, moves=False),
        )

    # -- cameras ---------------------------------------------------------------------------------------------------

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(camera.name for camera in self.cameras)

    def camera(self, name: str) -> CameraMount:
        """The camera of a name.

        Raises:
            UsageError: the robot has no such camera.
        """
        if name not in self.camera_names:
            raise unknown_name("camera", name, self.camera_names)
        return self.cameras[self.camera_names.index(name)]

    @cached_property
    def digest(self) -> bytes:
        """Hash of all that goes into a compiled model: equal when the models are equal."""
        body = self.body
        facts = (
            self.joints,
            sorted(self.groups.items()),
            self.base_link,
            self.base_height,
            self.tcp,
            self.fingers,
            self.force_links,
            self.trunk_links,
            self.distal_links,
            self.cameras,
            sorted(self.gains.items()),
            self.rest_qpos,
            body.tree,
            sorted(body.inertials.items()),
            list(body.collision.items()),
        )
        return hashlib.sha256(repr(facts).encode()).digest()


BASE_LIMITS = ((-20.0, 20.0), (-20.0, 20.0), (-np.inf, np.inf))
"""Limits of the joints of every base: x, y [m], yaw [rad]."""
