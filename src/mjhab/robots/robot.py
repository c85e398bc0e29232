"""The `Robot` spec. All other code takes names and indices of joints, links and cameras from it.

A robot is a mobile manipulator: a base with three planar joints, an arm with a parallel gripper and, optionally, a
torso that lifts the arm and a head. `robots.registry` holds the robots by name.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from mjhab.core.errors import missing_field, shown, unknown_name, wrong_type
from mjhab.core.joints import BASE, GROUPS, JointColumns
from mjhab.core.typed.checks import check, check_one_of
from mjhab.core.typed.options import fitting, take_types
from mjhab.robots.body_check import BodyNeeds, check_body, check_record
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
"""Function that returns the visual meshes: (body, mesh in the frame of that body [m], name of its material)."""


@dataclass(frozen=True)
class Footprint:
    """Free space that a base needs on the floor. Lengths [m].

    Attributes:
        radius: of the disc that covers the base.
        spawn: radius of the disc around a spawn that must be free.
        wide: disc radius with which the scripted experts plan paths first.
        narrow: disc radius with which they plan through narrow passages.
        top: height of the base.
    """

    radius: float
    spawn: float
    wide: float
    narrow: float
    top: float


@dataclass(frozen=True)
class ArmReach:
    """Reach of an arm, with which the scripted experts select poses before they solve inverse kinematics. Lengths [m].

    Attributes:
        ahead: distance of the arm's first joint in front of the centre of the base.
        out: distance of the second joint from the axis of the first.
        low: height of the second joint above the floor with the torso down.
        high: the same with the torso up.
        length: usable distance from the second joint to the wrist.
        hand: distance from the wrist to the tcp.
        level: least and largest usable horizontal distance of the hand from the second joint.
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

    Lists stand for tuples, and numbers of numpy for plain ones.

    Attributes:
        name: name in ``mjhab.make(robot=...)``.
        joints: names of the joints in the order of joint positions: base, posture, fingers (`core.joints`).
        groups: names of the joints of every group of GROUPS that the robot has. "arm" and "head" have the order of
            actions; "base" is x, y, yaw; "fingers" are two joints that open towards positive values [m].
        load_body: returns links, masses and collision shapes; called once, on first use.
        rest_qpos: (J,) joint positions at rest [m, rad].
        base_link: link that the base joints move.
        base_height: height of its frame above the floor [m]; the base has no contact with the floor.
        arm_root: link in whose frame end-effector actions are given; base and torso move it.
        tcp: link whose origin is the tool centre point (tcp): x along the fingers, y the line on which they close.
        fingers: left and right finger; empty for a robot without a gripper.
        force_links: links whose contact forces add up to ``robot_force``: all with collision shapes but the fingers.
        trunk_links: links with which the distal links collide.
        distal_links: links that collide with the trunk links. No other two links of the robot collide.
        arm_links: links that the experts keep clear of furniture: the arm without its last links, and the links on the
            torso.
        wrist_links: the last links before the hand.
        cameras: its cameras, the head camera first.
        gains: servo gains of every group of joints.
        stiff_gains: servo gains of torso and head under a control mode with a stiff body.
        gripper: sizes of hand and fingers.
        footprint: free space that the base needs.
        reach: reach of the arm.
        elbow: joint of the arm whose zero is the stretched arm.
        visuals: returns the visual meshes.
        ee_rest_pos: rest position of the tcp in success tests, in the frame of ``base_link`` [m]; None for the position
            at ``rest_qpos``.
        limits: ranges that actions of ±1 are scaled to.
        materials: materials of the visual meshes, by name.

    Raises:
        UsageError: a field is of another type or does not fit the others; the message names it.
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
        # Checked further below, with messages that name the group or camera.
        apart = ("groups", "cameras", "stiff_gains")
        take_types(self, apart, f"robot {shown(self.name)}")
        self._take_groups()
        for group in self.groups:
            check_one_of("joint group", group, GROUPS, where=f"robot {self.name!r}")
        named = sorted(joint for group in self.groups.values() for joint in group)
        check(
            named == sorted(self.joints),
            "groups",
            sorted(set(named) ^ set(self.joints)),
            "groups of which one has each joint",
            where=f"robot {self.name!r}",
        )
        check(
            # Code that is no part of a robot takes the base from the first three columns.
            self.joints[BASE] == self.group("base")
            and len(self.group("base")) == BASE.stop,
            "joints",
            self.joints[BASE],
            f"x, y and yaw of group 'base' {self.group('base')} at first",
            where=f"robot {self.name!r}",
        )
        fingers = set(self.group("fingers"))
        last = self.joints[len(self.joints) - len(fingers) :]
        check(
            set(last) == fingers,
            "joints",
            last,
            "those of group 'fingers' at last",
            where=f"robot {self.name!r}",
        )
        check(
            len(self.rest_qpos) == len(self.joints),
            "rest_qpos",
            self.rest_qpos,
            f"{len(self.joints)} values, one per joint",
            where=f"robot {self.name!r}",
        )
        self._check_gains()
        self._check_cameras()
        self._check_parts()

    def _take_groups(self) -> None:
        """Take the joints of every group as a tuple of names, and the cameras as a tuple."""
        owner = f"robot {self.name!r}"
        given = fitting("groups", Mapping, self.groups, owner)
        groups = {
            group: fitting(f"group {group!r}", tuple[str, ...], joints, owner)
            for group, joints in given.items()
        }
        object.__setattr__(self, "groups", groups)
        if not isinstance(self.cameras, list | tuple):
            raise wrong_type(
                "cameras", self.cameras, "a tuple of CameraMount", where=owner
            )
        object.__setattr__(self, "cameras", tuple(self.cameras))

    def _check_parts(self) -> None:
        """Check the types of the fields of gains, fingers and sizes."""
        parts = {f"gains of {group!r}": gains for group, gains in self.gains.items()}
        parts |= {f"finger {finger.link!r}": finger for finger in self.fingers}
        for name in ("stiff_gains", "gripper", "footprint", "reach", "limits"):
            parts[name] = getattr(self, name)
        for name, part in parts.items():
            # Here and not in their classes, where the message could not name the robot.
            check_record(part, f"robot {self.name!r}: {name}")
        owner = f"robot {self.name!r}"
        for name, material in self.materials.items():
            fitting(f"material {name!r}", Material, material, owner)

    def _check_gains(self) -> None:
        lacking = [g for g in GROUPS if self.group(g) and g not in self.gains]
        check(
            not lacking,
            "gains",
            tuple(self.gains),
            f"given for every group; {' and '.join(lacking)} lack them",
            where=f"robot {self.name!r}",
        )
        for group, gains in (*self.gains.items(), ("stiff_gains", self.stiff_gains)):
            if not isinstance(gains, Gains):
                raise wrong_type(
                    f"gains of {group!r}", gains, "a Gains", where=f"robot {self.name!r}"
                )
        arm = self.group("arm")
        if arm and self.elbow not in arm:
            raise unknown_name(
                "joint of the arm", self.elbow, arm, where=f"robot {self.name!r}: elbow"
            )

    def _check_cameras(self) -> None:
        for k, camera in enumerate(self.cameras):
            if not isinstance(camera, CameraMount):
                raise wrong_type(
                    f"cameras[{k}]", camera, "a CameraMount", where=f"robot {self.name!r}"
                )
            check_record(camera, f"robot {self.name!r}: cameras[{k}]")
            check(
                camera.name not in self.camera_names[:k],
                f"cameras[{k}]",
                camera.name,
                "a camera of another name than those before it",
                where=f"robot {self.name!r}",
            )
            check(
                0.0 < camera.fovy < np.pi,
                f"fovy of camera {camera.name!r}",
                camera.fovy,
                "between 0 and pi [rad]",
                where=f"robot {self.name!r}",
            )

    # -- joints ----------------------------------------------------------------------------------------------------

    def group(self, name: str) -> tuple[str, ...]:
        """Return the names of the joints of a group; () if the robot lacks it.

        Raises:
            UsageError: ``name`` is not one of GROUPS.
        """
        if name not in GROUPS:
            raise unknown_name("joint group", name, GROUPS)
        return tuple(self.groups.get(name, ()))

    def require(self, groups: Iterable[str], purpose: str) -> None:
        """Check that the robot has joint groups.

        Raises:
            UsageError: it lacks one; the message names it and the ``purpose`` that needs it.
        """
        missing = [group for group in groups if not self.group(group)]
        if missing:
            raise missing_field(
                f"joint group {' and '.join(map(repr, missing))}",
                f"robot {self.name!r}",
                f"{purpose} needs it. The robot has: {', '.join(g for g in GROUPS if self.group(g))}.",
            )

    def columns_of(self, joints: Iterable[str]) -> tuple[int, ...]:
        """Return the columns of joints in arrays (..., J) of joint positions.

        Raises:
            UsageError: the robot has no such joint.
        """
        found = []
        for joint in joints:
            if joint not in self.joints:
                raise unknown_name("joint", joint, self.joints)
            found.append(self.joints.index(joint))
        return tuple(found)

    @cached_property
    def body_joints(self) -> tuple[str, ...]:
        """Names of the joints of head, then torso: they follow the gripper in an action."""
        return (*self.group("head"), *self.group("torso"))

    @cached_property
    def arm_columns(self) -> tuple[int, ...]:
        """Columns of the arm joints, in the order of actions."""
        return self.columns_of(self.group("arm"))

    @cached_property
    def head_columns(self) -> tuple[int, ...]:
        """Columns of the head joints, in the order of actions."""
        return self.columns_of(self.group("head"))

    @cached_property
    def torso_columns(self) -> tuple[int, ...]:
        """Columns of the torso joints."""
        return self.columns_of(self.group("torso"))

    @cached_property
    def body_columns(self) -> tuple[int, ...]:
        """Columns of the head and torso joints, in the order of actions."""
        return self.columns_of(self.body_joints)

    @cached_property
    def finger_columns(self) -> tuple[int, ...]:
        """Columns of the finger joints."""
        return self.columns_of(self.group("fingers"))

    @cached_property
    def elbow_column(self) -> int:
        """Column of the elbow joint."""
        return self.columns_of((self.elbow,))[0]

    @cached_property
    def columns(self) -> JointColumns:
        """Columns of base, posture and fingers in arrays of joint positions."""
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
        """(low, high) of every joint [m or rad]; infinite for a joint without limits."""
        limits = {row.joint: row.limits for row in self.body.tree if row.joint}
        base = dict(zip(self.group("base"), BASE_LIMITS, strict=True))
        return tuple((limits | base)[joint] for joint in self.joints)

    @cached_property
    def endless(self) -> tuple[bool, ...]:
        """For every joint whether it turns without limits: its angle grows with every turn; False for the base."""
        return tuple(
            # The base turns without limits, too, and its yaw is an orientation and no joint angle.
            column >= BASE.stop and not np.isfinite(low)
            for column, (low, _) in enumerate(self.joint_limits)
        )

    @cached_property
    def finger_max(self) -> float:
        """Upper limit [m] of a finger joint: the gripper is fully open."""
        return self.joint_limits[self.finger_columns[0]][1]

    @cached_property
    def sliding(self) -> frozenset[str]:
        """Names of the prismatic joints [m]; positions of the others are angles [rad]."""
        slides = {row.joint for row in self.body.tree if row.joint and row.slide}
        return frozenset(slides | set(self.group("base")[:2]))

    @cached_property
    def gains_of(self) -> dict[str, Gains]:
        """Servo gains by joint name."""
        return {
            joint: self.gains[group]
            for group in self.groups
            for joint in self.group(group)
        }

    # -- links -----------------------------------------------------------------------------------------------------

    @cached_property
    def body(self) -> Body:
        """Links, masses and collision shapes.

        Raises:
            UsageError: the links of ``load_body`` do not fit the other fields, see `check_body`.
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
        """Names of the links with collision shapes."""
        return tuple(self.body.collision)

    @property
    def finger_links(self) -> tuple[str, ...]:
        """Names of the links of the left and the right finger."""
        return tuple(finger.link for finger in self.fingers)

    @property
    def model_links(self) -> tuple[str, ...]:
        """Names of the links whose poses or forces are read: force links, fingers and tcp link."""
        return tuple(dict.fromkeys((*self.force_links, *self.finger_links, self.tcp)))

    @property
    def hand_links(self) -> tuple[str, ...]:
        """Names of the links of the end effector: tcp link and fingers."""
        return (self.tcp, *self.finger_links)

    @cached_property
    def arm_force_rows(self) -> tuple[int, ...]:
        """Indices into ``force_links`` of the links that are not trunk links."""
        rows = enumerate(self.force_links)
        return tuple(row for row, link in rows if link not in self.trunk_links)

    @cached_property
    def rest(self) -> np.ndarray:
        """(J,) joint positions at rest [m, rad], read-only."""
        rest = np.array(self.rest_qpos, dtype=np.float64)
        # It is cached, and everybody gets the same array.
        rest.flags.writeable = False
        return rest

    @cached_property
    def tool_at_rest(self) -> Vec3:
        """Rest position of the tcp in success tests, in the frame of ``base_link`` [m]."""
        if self.ee_rest_pos is not None:
            return self.ee_rest_pos
        # A robot that the original does not have: success means that the hand is back where it is at rest.
        x, y, z = self.chain.tip_pose(self.rest)[0][0]
        return (float(x), float(y), float(z) - self.base_height)

    @cached_property
    def chain(self) -> Chain:
        """Kinematic chain from the base to the tcp; its columns are all J joints."""
        return self.chain_with(())

    def chain_with(self, links: Iterable[str]) -> Chain:
        """Return `chain` extended by the frames of more links."""
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
        """Kinematic chain from ``arm_root`` to the tcp; its columns are the arm joints in the order of actions."""
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
        """Return the camera with a name.

        Raises:
            UsageError: the robot has no such camera.
        """
        if name not in self.camera_names:
            raise unknown_name("camera", name, self.camera_names)
        return self.cameras[self.camera_names.index(name)]

    @cached_property
    def digest(self) -> bytes:
        """Hash of everything about the robot that a compiled model depends on."""
        body = self.body
        facts = (
            self.joints,
            # Sorted: the order of a mapping says nothing about the robot.
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
            # Not sorted: the order of the shapes is that of the model's geoms.
            list(body.collision.items()),
        )
        return hashlib.sha256(repr(facts).encode()).digest()


BASE_LIMITS = ((-20.0, 20.0), (-20.0, 20.0), (-np.inf, np.inf))
"""Limits of the joints of every base: x, y [m], yaw [rad]."""
