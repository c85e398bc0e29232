"""Batched forward kinematics and Jacobians of a robot tree, in numpy.

The tree is given by the caller (the environment hands the robot's joint table over), so that this module knows
no robot file. Joint columns follow the order the caller names; for Fetch that is the order of ``FETCH_JOINTS``:
base x, y, yaw, torso lift, head pan, shoulder pan, head tilt, ... with the base joints in the world frame.

Letters: N configurations, Q joint columns, L links. Lengths [m], angles [rad], quaternions wxyz.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol

import numpy as np

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.rotations import quat_from_mat

Array = np.ndarray


class TreeRow(Protocol):
    """One link of the robot's table: where it sits on its parent and the joint between them ("" when fixed).

    ``origin`` [m] in the parent's frame; ``axis`` along x, y or z; ``slide``: prismatic, otherwise it turns;
    ``limits`` [m | rad], infinite where the joint is continuous; ``quat``: turn of the link frame at joint zero.
    """

    @property
    def link(self) -> str: ...
    @property
    def parent(self) -> str: ...
    @property
    def joint(self) -> str: ...
    @property
    def origin(self) -> tuple[float, float, float]: ...
    @property
    def axis(self) -> tuple[float, float, float]: ...
    @property
    def slide(self) -> bool: ...
    @property
    def limits(self) -> tuple[float, float]: ...
    @property
    def quat(self) -> tuple[float, float, float, float]: ...


@dataclass(frozen=True)
class Joint:
    """A joint ready for evaluation: it moves along or about ``sign`` times the principal axis number ``axis``."""

    name: str
    kind: Literal["slide", "hinge", "fixed"]
    parent: str
    child: str
    pos: tuple[float, float, float]
    axis: int = 2
    sign: float = 1.0


@dataclass(frozen=True, eq=False)
class Frames:
    """World poses of links: ``pos`` (N, L, 3), ``rot`` (N, L, 3, 3) with the link axes as columns."""

    links: tuple[str, ...]
    pos: Array
    rot: Array

    def of(self, link: str) -> tuple[Array, Array]:
        """Position (N, 3) and rotation (N, 3, 3) of one link.

        Raises:
            UsageError: the chain holds no such link.
        """
        if link not in self.links:
            raise unknown_name("link", link, self.links)
        i = self.links.index(link)
        return self.pos[:, i], self.rot[:, i]


@dataclass(frozen=True, eq=False)
class Chain:
    """The links on the way from the root to a tip (and to any extra links), ready for batched evaluation.

    Build it with `from_tree`. ``joints[i]`` leads to link ``i + 1``; link 0 is the root. ``column[i]`` is the joint's
    place in ``q`` (-1: fixed). ``lower``, ``upper`` (Q,) are the limits of all Q columns.
    """

    joints: tuple[Joint, ...]
    column: tuple[int, ...]
    parent: tuple[int, ...]
    tip: str
    order: tuple[str, ...]
    lower: Array
    upper: Array
    root_height: float

    @classmethod
    def from_tree(
        cls,
        tree: Sequence[TreeRow],
        order: Sequence[str],
        *,
        tip: str = "gripper_link",
        extra: Sequence[str] = (),
        root: str = "base_link",
        root_height: float = 0.02,
    ) -> Chain:
        """Pick from a joint table what leads to ``tip`` and to the ``extra`` links.

        Args:
            tree: every link below ``root``, see `TreeRow`; links on the way must be parallel to their parents at zero.
            order: names of the Q columns of ``q``; the first three are the base's x, y and yaw, which the tree lacks.
            tip: link whose pose is controlled (Fetch: ``gripper_link`` is the tool centre point).
            extra: more links whose frames are wanted.
            root: the moving base.
            root_height: height of the base frame above the floor [m].

        Raises:
            UsageError: a link or joint name that the tree does not hold, or an axis that is not x, y or z.
        """
        rows = {row.link: row for row in tree}
        wanted = _base_joints(order, root)
        for link in (tip, *extra):
            _collect(link, rows, wanted)
        links = [wanted[0].parent, *(j.child for j in wanted)]
        column = tuple(_column(joint, order) for joint in wanted)
        limits = {row.joint: row.limits for row in tree if row.joint}
        bounds = np.array([limits.get(name, (-np.inf, np.inf)) for name in order], dtype=np.float64)
        parent = tuple(links.index(j.parent) for j in wanted)
        return cls(tuple(wanted), column, parent, tip, tuple(order), bounds[:, 0], bounds[:, 1], root_height)

    @property
    def size(self) -> int:
        """Number Q of joint columns."""
        return len(self.order)

    @cached_property
    def links(self) -> tuple[str, ...]:
        """Names of the L links, root first."""
        return (self.joints[0].parent, *(joint.child for joint in self.joints))

    @cached_property
    def tip_index(self) -> int:
        """Index of the tip among `links`."""
        return self.links.index(self.tip)

    @cached_property
    def tip_joints(self) -> tuple[int, ...]:
        """Indices into ``joints`` of the moving joints that move the tip, root first."""
        found: list[int] = []
        link = self.tip_index
        while link > 0:
            if self.column[link - 1] >= 0:
                found.append(link - 1)
            link = self.parent[link - 1]
        return tuple(reversed(found))

    def columns_of(self, names: Sequence[str]) -> Array:
        """Column indices (len(names),) of joints by name.

        Raises:
            UsageError: a name that is no column.
        """
        for name in names:
            if name not in self.order:
                raise unknown_name("joint", name, self.order)
        return np.array([self.order.index(name) for name in names], dtype=np.int64)

    def forward(self, q: Array) -> Frames:
        """World frames of every link for ``q`` (N, Q) or (Q,); base columns are world x, y [m] and yaw [rad]."""
        q = np.atleast_2d(np.asarray(q, dtype=np.float64))
        count, n_links = len(q), len(self.links)
        pos = np.empty((count, n_links, 3))
        axes = np.empty((count, n_links, 3, 3))  # [n, link, axis, xyz]: rows are the link axes
        pos[:, 0] = (0.0, 0.0, self.root_height)
        axes[:, 0] = np.eye(3)
        cos, sin = np.cos(q), np.sin(q)
        for i, joint in enumerate(self.joints):
            up, link, col = self.parent[i], i + 1, self.column[i]
            point = pos[:, up]
            for k in range(3):
                if joint.pos[k]:
                    point = point + joint.pos[k] * axes[:, up, k]
            axes[:, link] = axes[:, up]
            if joint.kind == "slide":
                k, sign = joint.axis, joint.sign
                point = point + sign * q[:, col, None] * axes[:, up, k]
            elif joint.kind == "hinge":
                k, sign = joint.axis, joint.sign
                a, b = (k + 1) % 3, (k + 2) % 3
                c, s = cos[:, col, None], sign * sin[:, col, None]
                axes[:, link, a] = c * axes[:, up, a] + s * axes[:, up, b]
                axes[:, link, b] = c * axes[:, up, b] - s * axes[:, up, a]
            pos[:, link] = point
        return Frames(self.links, pos, axes.swapaxes(-1, -2))

    def tip_pose(self, q: Array) -> tuple[Array, Array]:
        """Tip position (N, 3) and rotation (N, 3, 3) in the world."""
        frames = self.forward(q)
        return frames.pos[:, self.tip_index], frames.rot[:, self.tip_index]

    def jacobian(self, q: Array, frames: Frames | None = None) -> Array:
        """Geometric Jacobian (N, 6, Q) of the tip in world axes: rows 0-2 velocity, 3-5 angular velocity.

        Args:
            q: (N, Q) or (Q,).
            frames: the result of `forward` for the same ``q`` if it is at hand.
        """
        q = np.atleast_2d(np.asarray(q, dtype=np.float64))
        frames = self.forward(q) if frames is None else frames
        jac = np.zeros((len(q), 6, self.size))
        tip = frames.pos[:, self.tip_index]
        for i in self.tip_joints:
            joint = self.joints[i]
            axis = joint.sign * frames.rot[:, i + 1, :, joint.axis]
            if joint.kind == "slide":
                jac[:, :3, self.column[i]] = axis
            else:
                jac[:, :3, self.column[i]] = _cross(axis, tip - frames.pos[:, i + 1])
                jac[:, 3:, self.column[i]] = axis
        return jac

    def clip(self, q: Array) -> Array:
        """``q`` moved into the joint limits."""
        return np.clip(q, self.lower, self.upper)


def in_base(base_pose: Array, points: Array) -> Array:
    """World points (N, 3) in the frame of base poses (N, 3: x, y, yaw), heights still above the floor."""
    yaw = base_pose[:, 2]
    dx, dy = points[:, 0] - base_pose[:, 0], points[:, 1] - base_pose[:, 1]
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * dx + s * dy, c * dy - s * dx, points[:, 2]], axis=1)


def wrap(angle: Array | float) -> Array:
    """Angles moved to [-pi, pi)."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def rotation_vector(rot: Array) -> Array:
    """Rotation vectors (..., 3) [rad], length in [0, pi], of rotation matrices (..., 3, 3)."""
    quat = quat_from_mat(rot)
    sin_half = np.linalg.norm(quat[..., 1:], axis=-1)
    angle = 2 * np.arctan2(sin_half, quat[..., 0])
    scale = np.where(sin_half > 1e-9, angle / np.maximum(sin_half, 1e-12), 2.0)
    return quat[..., 1:] * scale[..., None]


def _cross(a: Array, b: Array) -> Array:
    # numpy's cross costs several times more for small batches.
    return np.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        axis=-1,
    )


def _column(joint: Joint, order: Sequence[str]) -> int:
    if joint.kind == "fixed":
        return -1
    if joint.name not in order:
        raise unknown_name("joint column", joint.name, order)
    return order.index(joint.name)


def _base_joints(order: Sequence[str], root: str) -> list[Joint]:
    names = ("world", "base_x", "base_y", root)
    kinds: tuple[Literal["slide", "hinge"], ...] = ("slide", "slide", "hinge")
    return [Joint(order[k], kinds[k], names[k], names[k + 1], (0.0, 0.0, 0.0), k) for k in range(3)]


def _collect(link: str, rows: dict[str, TreeRow], into: list[Joint]) -> None:
    have = {joint.child for joint in into}
    path: list[Joint] = []
    while link not in have:
        if link not in rows:
            raise unknown_name("link", link, rows)
        path.append(_joint(rows[link]))
        link = rows[link].parent
    into.extend(reversed(path))


def _joint(row: TreeRow) -> Joint:
    if abs(abs(row.quat[0]) - 1.0) > 1e-9:
        raise UsageError(f"link {row.link!r} is turned against its parent at zero; such links cannot be in a chain")
    if not row.joint:
        return Joint(row.link, "fixed", row.parent, row.link, row.origin)
    for k in range(3):
        if abs(abs(row.axis[k]) - 1.0) < 1e-12:
            kind: Literal["slide", "hinge"] = "slide" if row.slide else "hinge"
            return Joint(row.joint, kind, row.parent, row.link, row.origin, k, row.axis[k])
    raise UsageError(f"joint {row.joint!r} has axis {row.axis}; only axes along x, y or z are supported")
