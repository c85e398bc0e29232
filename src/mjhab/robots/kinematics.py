"""Batched forward kinematics, Jacobians and damped least-squares steps of a robot tree, on numpy and torch.

The end-effector controllers and the scripted experts use it. The caller gives the tree of links, so that this module
reads no robot file. Joint columns follow the order the caller names; those of a moving base are x, y and yaw
in the world.

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
    between,
    constant,
    empty,
    indices,
    may_hold,
    namespace,
    norm3,
    zeros,
)
from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.rotations import quat_from_mat

DAMPING = 1e-4
"""Least damping of the normal equations; more is added far from the goal, where the linear model is poor."""
DAMPING_PER_ERROR = 0.03
"""Damping that is added per squared length of the error, which counts up to a length of 1."""
_EYES = {
    n: Table(tuple(tuple(float(i == k) for k in range(n)) for i in range(n))) for n in range(1, 7)
}
_EYE = _EYES[3]


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


@dataclass(frozen=True)
class ChainRoot:
    """The first link of a chain.

    Attributes:
        link: its name: the moving base, or the link whose frame everything is given in.
        height: of its frame above the floor [m].
        moves: it is a base with the columns x, y and yaw; False: it stands at the origin, and all columns are joints
            of the tree.
    """

    link: str
    height: float = 0.0
    moves: bool = True


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
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Joints by group, as in `Robot.groups`; empty for a chain that knows none."""

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
        """Pick from a joint table what leads to ``tip`` and to the ``extra`` links.

        Args:
            tree: every link below that of ``root``, see `TreeRow`; links on the way must be parallel to their
                parents at zero.
            order: names of the Q columns of ``q``; the first three are the base's x, y and yaw, which the tree lacks
                (unless the root does not move).
            tip: link whose pose is controlled: the tool centre.
            root: the link that everything is given from.
            extra: more links whose frames are wanted.
            groups: joints by group, for those who move some of them only.

        Raises:
            UsageError: a link or joint name that the tree does not hold, or an axis that is not x, y or z.
        """
        rows = {row.link: row for row in tree}
        wanted = _base_joints(order, root.link) if root.moves else []
        for link in (tip, *extra):
            _collect(link, rows, wanted, root.link)
        links = [wanted[0].parent, *(j.child for j in wanted)]
        column = tuple(_column(joint, order) for joint in wanted)
        limits = {row.joint: row.limits for row in tree if row.joint}
        bounds = np.array([limits.get(name, (-np.inf, np.inf)) for name in order], dtype=np.float64)
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
        q = _rows(q)
        xp = namespace(q)
        count = len(q)
        n_links = len(self.links)
        pos = empty((count, n_links, 3), q)
        axes = empty((count, n_links, 3, 3), q)  # [n, link, axis, xyz]: rows are the link axes
        pos[:, 0] = constant((0.0, 0.0, self.root_height), q)
        axes[:, 0] = constant(_EYE, q)
        cos = xp.cos(q)
        sin = xp.sin(q)
        for i, joint in enumerate(self.joints):
            up = self.parent[i]
            link = i + 1
            col = self.column[i]
            point = pos[:, up]
            for k in range(3):
                if joint.pos[k]:
                    point = point + joint.pos[k] * axes[:, up, k]
            axes[:, link] = axes[:, up]
            if joint.kind == "slide":
                k = joint.axis
                sign = joint.sign
                point = point + sign * q[:, col, None] * axes[:, up, k]
            elif joint.kind == "hinge":
                k = joint.axis
                sign = joint.sign
                a = (k + 1) % 3
                b = (k + 2) % 3
                c = cos[:, col, None]
                s = sign * sin[:, col, None]
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
        """Link, axis number, column, sign (K, 1) and "it turns" (K, 1) of the K joints that move the tip."""
        joints = [self.joints[i] for i in self.tip_joints]
        return (
            Table(tuple(i + 1 for i in self.tip_joints)),
            Table(tuple(joint.axis for joint in joints)),
            Table(tuple(self.column[i] for i in self.tip_joints)),
            Table(tuple((joint.sign,) for joint in joints)),
            Table(tuple((float(joint.kind == "hinge"),) for joint in joints)),
        )

    def clip(self, q: np.ndarray) -> np.ndarray:
        """``q`` moved into the joint limits."""
        return np.clip(q, self.lower, self.upper)


def in_base(base_pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """World points (N, 3) in the frame of base poses (N, 3: x, y, yaw), heights still above the floor."""
    yaw = base_pose[:, 2]
    dx = points[:, 0] - base_pose[:, 0]
    dy = points[:, 1] - base_pose[:, 1]
    c = np.cos(yaw)
    s = np.sin(yaw)
    return np.stack([c * dx + s * dy, c * dy - s * dx, points[:, 2]], axis=1)


def wrap(angle: np.ndarray | float) -> np.ndarray:
    """Angles moved to [-pi, pi)."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def rotation_vector(rot: Array) -> Array:
    """Rotation vectors (..., 3) [rad], length in [0, pi], of rotation matrices (..., 3, 3)."""
    xp = namespace(rot)
    quat = quat_from_mat(rot)
    sin_half = norm3(quat[..., 1:])
    angle = 2 * xp.atan2(sin_half, quat[..., 0])
    scale = xp.where(
        sin_half > 1e-9, angle / xp.maximum(sin_half, constant((1e-12,), sin_half)), 2.0
    )
    return quat[..., 1:] * scale[..., None]


def rotate(vector: Array) -> Array:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3) [rad]."""
    xp = namespace(vector)
    angle = norm3(vector)[:, None, None]
    x = vector[:, 0]
    y = vector[:, 1]
    z = vector[:, 2]
    zero = xp.zeros_like(x)
    skew = xp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    safe = xp.maximum(angle, constant((1e-9,), angle))
    first = xp.where(angle > 1e-6, xp.sin(angle) / safe, 1.0)
    second = xp.where(angle > 1e-6, (1 - xp.cos(angle)) / safe**2, 0.5)
    return constant(_EYE, vector) + first * skew + second * (skew @ skew)


def damped_step(error: Array, jac: Array, pull: Array, damping: float = DAMPING) -> Array:
    """Joint changes (N, D) for an error (N, E) under the Jacobian (N, E, D).

    ``pull`` (N, D) is let through in the null space; ``damping``: see DAMPING.
    """
    xp = namespace(error)
    size = xp.minimum(xp.sum(error * error, axis=1), constant((1.0,), error))
    square = jac @ jac.swapaxes(1, 2) + (damping + DAMPING_PER_ERROR * size)[
        :, None, None
    ] * constant(_EYES[error.shape[1]], error)
    wanted = error - xp.einsum("nij,nj->ni", jac, pull)
    return xp.einsum("nij,ni->nj", jac, _solve(square, wanted)) + pull


def _solve(square: Array, wanted: Array) -> Array:
    """The ``x`` (N, E) of ``square x = wanted`` for symmetric positive definite matrices (N, E, E)."""
    if isinstance(square, np.ndarray):
        return np.linalg.solve(square, wanted[..., None])[..., 0]
    # torch's solver asks the device whether it succeeded. Elimination without pivots does for these matrices.
    xp = namespace(square)
    eye = constant(_EYES[wanted.shape[1]], wanted)
    both = xp.concat([square, wanted[..., None]], axis=2)
    for k in range(wanted.shape[1]):
        row = both[:, k] / both[:, k, k, None]
        both = both - (both[:, :, k] - eye[k])[..., None] * row[:, None]
    return both[..., -1]


@dataclass(frozen=True, eq=False)
class StepBounds:
    """Bounds of a step: ``low``, ``high`` (N, D): room left to the limits of the columns; ``largest``: most that a
    column changes, one number or (D,)."""

    low: Array
    high: Array
    largest: Array | float


def limited_step(
    error: Array,
    jac: Array,
    pull: Array,
    bounds: StepBounds,
    damping: float = DAMPING,
) -> Array:
    """A damped step (N, D) within bounds that leaves what limited columns cannot do to the others.

    A column that would pass its limit goes to its limit, and the step of the others is computed anew for the error
    that remains; clipping alone would stall at the limits.

    Args:
        error, jac, pull: see `damped_step`.
        bounds: of the step.
        damping: see `damped_step`.
    """
    low = bounds.low
    high = bounds.high
    xp = namespace(error)
    stopped = xp.zeros_like(pull)
    free = xp.ones_like(pull)
    for last in (False, False, True):
        remaining = error - xp.einsum("nij,nj->ni", jac, stopped)
        step = _bounded(
            stopped + damped_step(remaining, jac * free[:, None], pull * free, damping) * free,
            bounds.largest,
        )
        over = (free > 0) & ((step < low) | (step > high))
        if last or not may_hold(over):
            break
        stopped = xp.where(over, between(step, low, high), stopped)
        free = xp.where(over, 0.0, free)
    return step


def _bounded(step: Array, largest: Array | float) -> Array:
    xp = namespace(step)
    share = xp.max(xp.abs(step) / largest, axis=1, keepdims=True)
    return step / xp.maximum(share, constant((1.0,), share))


def _rows(q: Array) -> Array:
    """Configurations (N, Q) of numbers (N, Q) or (Q,): numpy in float64, tensors (N, Q) as they are."""
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
    return [Joint(order[k], kinds[k], names[k], names[k + 1], (0.0, 0.0, 0.0), k) for k in range(3)]


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
        raise UsageError(
            f"link {row.link!r} is turned against its parent at zero; such links cannot be in a chain"
        )
    if not row.joint:
        return Joint(row.link, "fixed", row.parent, row.link, row.origin)
    for k in range(3):
        if abs(abs(row.axis[k]) - 1.0) < 1e-12:
            kind: Literal["slide", "hinge"] = "slide" if row.slide else "hinge"
            return Joint(row.joint, kind, row.parent, row.link, row.origin, k, row.axis[k])
    raise UsageError(
        f"joint {row.joint!r} has axis {row.axis}; only axes along x, y or z are supported"
    )
