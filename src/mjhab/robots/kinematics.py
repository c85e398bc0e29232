"""Batched forward kinematics and Jacobians of a robot tree, on numpy and torch.

The end-effector controllers and the scripted experts use it, with the steps of `damped_steps`. The caller gives the
tree of links and the order of the joint columns; those of a moving base are x, y and yaw in the world frame.

Letters: N configurations, Q joint columns, L links. Lengths [m], angles [rad], quaternions wxyz. Results are float64
for numpy and of the tensor's dtype for torch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Protocol

import numpy as np

from mjhab.core.arrays import (
    Array,
    Table,
    constant,
    empty,
    indices,
    namespace,
    zeros,
)
from mjhab.core.errors import fault, unknown_name, wrong_value
from mjhab.core.rotations import IDENTITY_MATRIX


class TreeRow(Protocol):
    """One link of a robot tree and its joint, as `robots.parts.TreeLink`; ``joint`` is "" for a fixed link.

    ``origin`` [m]: position in the parent's frame; ``axis``: along x, y or z; ``slide``: prismatic, else a hinge;
    ``limits`` [m or rad]: infinite for a continuous joint; ``quat``: orientation in the parent's frame at zero, wxyz.
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
    """A joint of a chain. Its axis is ``sign`` times axis number ``axis`` (0 x, 1 y, 2 z) of the parent's frame.

    ``pos`` [m]: position of the child frame in the parent's frame at zero.
    """

    name: str
    kind: Literal["slide", "hinge", "fixed"]
    parent: str
    child: str
    pos: tuple[float, float, float]
    axis: int = 2
    sign: float = 1.0


@dataclass(frozen=True, eq=False)
class Frames:
    """World poses of links: ``pos`` (N, L, 3) [m], ``rot`` (N, L, 3, 3) with the link axes as columns."""

    links: tuple[str, ...]
    pos: Array
    rot: Array

    def of(self, link: str) -> tuple[Array, Array]:
        """Return the world position (N, 3) [m] and rotation (N, 3, 3) of one link.

        Raises:
            UsageError: the chain has no such link.
        """
        if link not in self.links:
            raise unknown_name("link", link, self.links)
        i = self.links.index(link)
        return self.pos[:, i], self.rot[:, i]


@dataclass(frozen=True)
class ChainRoot:
    """The first link of a chain.

    Attributes:
        link: its name.
        height: height of its frame above the floor [m].
        moves: True for a base with the columns x, y and yaw; False for a link fixed at the origin, so that poses of the
            chain are in its frame.
    """

    link: str
    height: float = 0.0
    moves: bool = True


@dataclass(frozen=True, eq=False)
class Chain:
    """The links between a root and a tip (and extra links), for batched evaluation. Build it with `from_tree`.

    Attributes:
        joints: joint ``i`` moves link ``i + 1``; link 0 is the root.
        column: column in ``q`` of each joint, -1 for a fixed one.
        parent: index of the parent link of each joint.
        tip: name of the tip link.
        order: names of the Q columns of ``q``.
        lower: (Q,) lower limits [m or rad].
        upper: (Q,) upper limits [m or rad].
        root_height: height of the root frame above the floor [m].
    """

    joints: tuple[Joint, ...]
    column: tuple[int, ...]
    parent: tuple[int, ...]
    tip: str
    order: tuple[str, ...]
    lower: Array
    upper: Array
    root_height: float
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Joint names by group, as in `Robot.groups`; may be empty."""

    @classmethod
    def from_tree(
        cls,
        tree: Sequence[TreeRow],
        order: Sequence[str],
        *,
        tip: str,
        root: ChainRoot,
        extra: Sequence[str] = (),
        groups: Mapping[str, tuple[str, ...]] | None = None,
    ) -> Chain:
        """Build the chain from a root to ``tip`` and to the ``extra`` links.

        Args:
            tree: every link below the root; frames of links on the chain must be parallel to their parents at zero.
            order: names of the Q columns of ``q``. With a moving root the first three are the base's x, y and yaw,
                which are not in the tree.
            tip: link whose pose is controlled: the tcp.
            root: first link of the chain.
            extra: more links whose frames are needed.
            groups: joint names by group, for callers that move one group only.

        Raises:
            UsageError: the tree lacks a link or joint, a link is turned against its parent at zero, or an axis is not
                x, y or z.
        """
        rows = {row.link: row for row in tree}
        # x, y, yaw in this order, as the model has them: a yaw first would turn the others.
        wanted = _base_joints(order, root.link) if root.moves else []
        for link in (tip, *extra):
            _collect(link, rows, wanted, root.link)
        links = [wanted[0].parent, *(j.child for j in wanted)]
        column = tuple(_column(joint, order) for joint in wanted)
        limits = {row.joint: row.limits for row in tree if row.joint}
        bounds = np.array(
            [limits.get(name, (-np.inf, np.inf)) for name in order], dtype=np.float64
        )
        parent = tuple(links.index(j.parent) for j in wanted)
        return cls(
            tuple(wanted),
            column,
            parent,
            tip,
            tuple(order),
            bounds[:, 0],
            bounds[:, 1],
            root.height,
            dict(groups or {}),
        )

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
        """Indices into ``joints`` of the joints that move the tip, root first."""
        found: list[int] = []
        link = self.tip_index
        while link > 0:
            # Fixed joints move nothing.
            if self.column[link - 1] >= 0:
                found.append(link - 1)
            link = self.parent[link - 1]
        return tuple(reversed(found))

    def columns_of(self, names: Sequence[str]) -> Array:
        """Return the column indices (len(names),) of joints by name.

        Raises:
            UsageError: a name is not a column.
        """
        for name in names:
            if name not in self.order:
                raise unknown_name("joint", name, self.order)
        return np.array([self.order.index(name) for name in names], dtype=np.int64)

    def forward(self, q: Array) -> Frames:
        """Compute the world poses of all links.

        Args:
            q: (N, Q) or (Q,) joint positions [m, rad]; base columns are x, y and yaw in the world frame.
        """
        q = _rows(q)
        xp = namespace(q)
        count = len(q)
        n_links = len(self.links)
        pos = empty((count, n_links, 3), q)
        axes = empty(
            (count, n_links, 3, 3), q
        )  # [n, link, axis, xyz]: rows are the link axes
        pos[:, 0] = constant((0.0, 0.0, self.root_height), q)
        axes[:, 0] = constant(IDENTITY_MATRIX, q)
        # For all columns in one call; those of sliding joints are not used.
        cos = xp.cos(q)
        sin = xp.sin(q)
        for i, joint in enumerate(self.joints):
            up = self.parent[i]
            link = i + 1
            col = self.column[i]
            point = pos[:, up]
            for k in range(3):
                # Most offsets have one or two numbers that are 0.
                if joint.pos[k]:
                    point = point + joint.pos[k] * axes[:, up, k]
            # Written first for all kinds: a hinge then replaces two of the three axes.
            axes[:, link] = axes[:, up]
            if joint.kind == "slide":
                k = joint.axis
                sign = joint.sign
                point = point + sign * q[:, col, None] * axes[:, up, k]
            elif joint.kind == "hinge":
                k = joint.axis
                sign = joint.sign
                # A turn about axis k mixes the other two and leaves k as it is.
                a = (k + 1) % 3
                b = (k + 2) % 3
                c = cos[:, col, None]
                s = sign * sin[:, col, None]
                axes[:, link, a] = c * axes[:, up, a] + s * axes[:, up, b]
                axes[:, link, b] = c * axes[:, up, b] - s * axes[:, up, a]
            pos[:, link] = point
        # Kept transposed on the way, so that an axis is a contiguous row.
        return Frames(self.links, pos, axes.swapaxes(-1, -2))

    def tip_pose(self, q: Array) -> tuple[Array, Array]:
        """Compute the world position (N, 3) [m] and rotation (N, 3, 3) of the tip for ``q`` (N, Q) or (Q,)."""
        frames = self.forward(q)
        return frames.pos[:, self.tip_index], frames.rot[:, self.tip_index]

    def jacobian(self, q: Array, frames: Frames | None = None) -> Array:
        """Compute the geometric Jacobian (N, 6, Q) of the tip in world axes: rows 0-2 linear, 3-5 angular velocity.

        Args:
            q: (N, Q) or (Q,) joint positions [m, rad].
            frames: result of `forward` for the same ``q``, to save computing it again.
        """
        q = _rows(q)
        frames = self.forward(q) if frames is None else frames
        where = namespace(q).where
        movers = self._tip_movers
        links, axes, columns = (indices(values, q) for values in movers[:3])
        signs = constant(movers[3], q)
        turns = constant(movers[4], q) > 0.5
        axis = signs * frames.rot[:, links, :, axes].swapaxes(0, 1)
        arm = frames.pos[:, self.tip_index, None] - frames.pos[:, links]
        jac = zeros((len(q), 6, self.size), q)
        jac[:, :3, columns] = where(turns, _cross(axis, arm), axis).swapaxes(1, 2)
        jac[:, 3:, columns] = where(turns, axis, 0.0).swapaxes(1, 2)
        return jac

    @cached_property
    def _tip_movers(self) -> tuple[Table, Table, Table, Table, Table]:
        """Child link, axis number, column, sign (K, 1) and is-hinge flag (K, 1) of the K joints that move the tip."""
        joints = [self.joints[i] for i in self.tip_joints]
        return (
            Table(tuple(i + 1 for i in self.tip_joints)),
            Table(tuple(joint.axis for joint in joints)),
            Table(tuple(self.column[i] for i in self.tip_joints)),
            Table(tuple((joint.sign,) for joint in joints)),
            Table(tuple((float(joint.kind == "hinge"),) for joint in joints)),
        )

    def clip(self, q: np.ndarray) -> np.ndarray:
        """Return ``q`` (..., Q) clipped to the joint limits."""
        return np.clip(q, self.lower, self.upper)


def _rows(q: Array) -> Array:
    """Return ``q`` as (N, Q): numbers and numpy arrays (N, Q) or (Q,) as float64, tensors (N, Q) unchanged."""
    if isinstance(q, np.ndarray | Sequence):
        return np.atleast_2d(np.asarray(q, dtype=np.float64))
    return q


def _cross(a: Array, b: Array) -> Array:
    # numpy's cross costs several times more for small batches.
    return namespace(a).stack(
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
    return [
        Joint(order[k], kinds[k], names[k], names[k + 1], (0.0, 0.0, 0.0), k)
        for k in range(3)
    ]


def _collect(link: str, rows: dict[str, TreeRow], into: list[Joint], root: str) -> None:
    have = {joint.child for joint in into} | {root}
    path: list[Joint] = []
    while link not in have:
        if link not in rows:
            raise unknown_name("link", link, rows)
        path.append(_joint(rows[link]))
        link = rows[link].parent
    into.extend(reversed(path))


def _joint(row: TreeRow) -> Joint:
    if abs(abs(row.quat[0]) - 1.0) > 1e-9:
        raise fault(
            f"link {row.link!r}",
            "is turned against its parent at zero; such links cannot be in a chain",
        )
    if not row.joint:
        return Joint(row.link, "fixed", row.parent, row.link, row.origin)
    for k in range(3):
        # Axes along x, y, z save the general rotation about an axis in `forward`.
        if abs(abs(row.axis[k]) - 1.0) < 1e-12:
            kind: Literal["slide", "hinge"] = "slide" if row.slide else "hinge"
            return Joint(
                row.joint, kind, row.parent, row.link, row.origin, k, row.axis[k]
            )
    raise wrong_value(f"axis of joint {row.joint!r}", row.axis, "along x, y or z")
