"""Compiled frames of the links of a chain. Letters: N configurations, Q joint columns, L links."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mjhab.experts.jit import inline, kernel
from mjhab.robots.kinematics import Chain

Array = np.ndarray
FIXED = 0
SLIDE = 1
HINGE = 2


class Tree(NamedTuple):
    """A chain as arrays. Joint j leads from link ``parent[j]`` to link j + 1; link 0 is the root.

    parent, kind, axis, column (L - 1,) i64: kind is `FIXED`, `SLIDE` or `HINGE`, column -1 where the joint is fixed;
    sign (L - 1,); offset (L - 1, 3) of the joint in its parent's frame; path (J,) i64: the joints from the root to
    the tip; height of the root; lower, upper (Q,): joint limits.
    """

    parent: Array
    kind: Array
    axis: Array
    column: Array
    sign: Array
    offset: Array
    path: Array
    height: float
    lower: Array
    upper: Array


@lru_cache(maxsize=16)
def tree_of(chain: Chain) -> Tree:
    """The arrays of a chain."""
    path: list[int] = []
    link = chain.tip_index
    while link > 0:
        path.append(link - 1)
        link = chain.parent[link - 1]
    kinds = {"fixed": FIXED, "slide": SLIDE, "hinge": HINGE}
    return Tree(
        np.array(chain.parent, np.int64),
        np.array([kinds[joint.kind] for joint in chain.joints], np.int64),
        np.array([joint.axis for joint in chain.joints], np.int64),
        np.array(chain.column, np.int64),
        np.array([joint.sign for joint in chain.joints]),
        np.array([joint.pos for joint in chain.joints], np.float64),
        np.array(path[::-1], np.int64),
        float(chain.root_height),
        np.ascontiguousarray(chain.lower, np.float64),
        np.ascontiguousarray(chain.upper, np.float64),
    )


@inline
def place_link(tree: Tree, j: int, q: Array, pos: Array, rot: Array) -> None:
    """Write the frame of the link behind joint ``j`` into ``pos`` (L, 3) and ``rot`` (L, 3, 3), links as rows."""
    up = tree.parent[j]
    link = j + 1
    offset = tree.offset[j]
    for i in range(3):
        pos[link, i] = (
            pos[up, i]
            + offset[0] * rot[up, i, 0]
            + offset[1] * rot[up, i, 1]
            + offset[2] * rot[up, i, 2]
        )
        for k in range(3):
            rot[link, i, k] = rot[up, i, k]
    kind = tree.kind[j]
    axis = tree.axis[j]
    if kind == SLIDE:
        for i in range(3):
            pos[link, i] += tree.sign[j] * q[tree.column[j]] * rot[up, i, axis]
    elif kind == HINGE:
        c = np.cos(q[tree.column[j]])
        s = tree.sign[j] * np.sin(q[tree.column[j]])
        a = (axis + 1) % 3
        b = (axis + 2) % 3
        for i in range(3):
            rot[link, i, a] = c * rot[up, i, a] + s * rot[up, i, b]
            rot[link, i, b] = c * rot[up, i, b] - s * rot[up, i, a]


@inline
def place_root(tree: Tree, pos: Array, rot: Array) -> None:
    for i in range(3):
        pos[0, i] = 0.0
        for k in range(3):
            rot[0, i, k] = 1.0 if i == k else 0.0
    pos[0, 2] = tree.height


@kernel
def link_frames(tree: Tree, q: Array) -> tuple[Array, Array]:
    """World positions (N, L, 3) and rotations (N, L, 3, 3) of all links at configurations ``q`` (N, Q)."""
    links = len(tree.parent) + 1
    pos = np.empty((len(q), links, 3))
    rot = np.empty((len(q), links, 3, 3))
    for n in range(len(q)):
        place_root(tree, pos[n], rot[n])
        for j in range(links - 1):
            place_link(tree, j, q[n], pos[n], rot[n])
    return pos, rot
