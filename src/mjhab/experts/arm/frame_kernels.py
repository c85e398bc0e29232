"""Compiled forward kinematics of a chain. Letters: N configurations, Q joint columns, L links, J joints to the tip."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mjhab.experts.jit import inline, kernel
from mjhab.robots.kinematics import Chain

FIXED = 0
SLIDE = 1
HINGE = 2
"""Kinds of joints."""


class Tree(NamedTuple):
    """A kinematic chain as arrays. Joint j leads from link ``parent[j]`` to link j + 1; link 0 is the root.

    Attributes:
        parent: (L - 1,) int64 parent link of each joint.
        kind: (L - 1,) int64 `FIXED`, `SLIDE` or `HINGE`.
        axis: (L - 1,) int64 axis of each joint in its own frame: 0 x, 1 y, 2 z.
        column: (L - 1,) int64 column of a configuration that holds the joint's value; -1 for fixed joints.
        sign: (L - 1,) 1 or -1, direction of each joint along its axis.
        offset: (L - 1, 3) position of each joint in its parent's frame [m].
        path: (J,) int64 joints from the root to the tip.
        height: height of the root above the floor [m].
        lower: (Q,) lower joint limits [m or rad].
        upper: (Q,) upper joint limits [m or rad].
    """

    parent: np.ndarray
    kind: np.ndarray
    axis: np.ndarray
    column: np.ndarray
    sign: np.ndarray
    offset: np.ndarray
    path: np.ndarray
    height: float
    lower: np.ndarray
    upper: np.ndarray


# One per robot and set of links: converting takes longer than a kernel runs.
@lru_cache(maxsize=16)
def tree_of(chain: Chain) -> Tree:
    """Convert a chain to arrays for the kernels."""
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
        # Root first, as a frame needs that of its parent.
        np.array(path[::-1], np.int64),
        float(chain.root_height),
        np.ascontiguousarray(chain.lower, np.float64),
        np.ascontiguousarray(chain.upper, np.float64),
    )


@inline
def place_link(
    tree: Tree, j: int, q: np.ndarray, pos: np.ndarray, rot: np.ndarray
) -> None:
    """Write the world frame of link ``j + 1`` at configuration ``q`` (Q,) into ``pos`` (L, 3) and ``rot`` (L, 3, 3).

    The parent's frame must have been written before.
    """
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
def place_root(tree: Tree, pos: np.ndarray, rot: np.ndarray) -> None:
    """Write the world frame of the root into the first row of ``pos`` (L, 3) and ``rot`` (L, 3, 3)."""
    for i in range(3):
        pos[0, i] = 0.0
        for k in range(3):
            rot[0, i, k] = 1.0 if i == k else 0.0
    pos[0, 2] = tree.height


@kernel
def link_frames(tree: Tree, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World positions (N, L, 3) and rotations (N, L, 3, 3) of all links at configurations ``q`` (N, Q)."""
    links = len(tree.parent) + 1
    pos = np.empty((len(q), links, 3))
    rot = np.empty((len(q), links, 3, 3))
    for n in range(len(q)):
        place_root(tree, pos[n], rot[n])
        # Parents come before their children.
        for j in range(links - 1):
            place_link(tree, j, q[n], pos[n], rot[n])
    return pos, rot
