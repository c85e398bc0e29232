"""Clearance of the robot to obstacles and to itself, from spheres that cover its links and oriented boxes, in batches.

Letters: N configurations, M spheres, K boxes, L links, Q joint columns. Lengths [m], world frame unless said.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.rotations import mat_from_quat
from mjhab.experts.arm.frame_kernels import link_frames, tree_of
from mjhab.experts.arm.sphere_gaps import min_gaps, own_gaps
from mjhab.robots.kinematics import Chain, Frames

NOTHING_NEAR_M = 1e3
"""Distance that is reported when there are no boxes. Larger than any home."""
_THICK_RADIUS_M = 0.05
"""Boxes whose covering spheres have a larger radius also get small spheres along their edges."""
_EDGE_RADIUS_M = 0.03
"""Radius of the small spheres along edges."""


@dataclass(frozen=True, eq=False)
class RobotSpheres:
    """Spheres that cover the robot's links.

    Attributes:
        chain: kinematic chain with all covered links.
        link: (M,) index of each sphere's link among the chain's links.
        pos: (M, 3) centres in the frames of the links [m].
        radius: (M,) radii [m].
        trunk: (K) boxes of the links that the arm must not touch, each in the frame of its link.
        trunk_link: (K,) index of each trunk box's link.
        distal: (M,) bool, spheres that `self_clearance` checks against the trunk.
    """

    chain: Chain
    link: np.ndarray
    pos: np.ndarray
    radius: np.ndarray
    trunk: Boxes
    trunk_link: np.ndarray
    distal: np.ndarray

    @classmethod
    def from_geoms(
        cls,
        chain: Chain,
        geoms: Mapping[str, Sequence[Any]],
        *,
        skip: Sequence[str] = (),
        trunk: Sequence[str] = (),
        distal: Sequence[str] = (),
    ) -> RobotSpheres:
        """Cover collision shapes with spheres.

        Args:
            chain: chain that contains every link to be covered (``extra`` of `Chain.from_tree`).
            geoms: collision shapes of each link (fields ``shape``, ``size``, ``pos``, ``quat`` as in a scene's
                description); links that are not in the chain are ignored.
            skip: links that are not covered, e.g. the base, which the map of free floor keeps clear.
            trunk: links that are kept as boxes for `self_clearance`.
            distal: links whose spheres `self_clearance` checks.
        """
        link = []
        pos = []
        radius = []
        for i, name in enumerate(chain.links):
            # The base is skipped: the map of the floor keeps it clear, and more exactly.
            for geom in geoms.get(name, ()) if name not in skip else ():
                for points, size in _cover(geom):
                    link += [i] * len(points)
                    pos.append(points)
                    radius += [size] * len(points)
        pairs = [
            (chain.links.index(name), g)
            for name in trunk
            if name in chain.links
            for g in geoms.get(name, ())
        ]
        rows = np.array(link, dtype=np.int64)
        chosen = [i for i, name in enumerate(chain.links) if name in distal]
        return cls(
            chain,
            rows,
            np.concatenate(pos),
            np.array(radius),
            _bounding([g for _, g in pairs]),
            np.array([i for i, _ in pairs], dtype=np.int64),
            np.isin(rows, chosen),
        )

    def with_held(self, pos: np.ndarray, radius: np.ndarray) -> RobotSpheres:
        """The robot with a held object: additional spheres ``pos`` (H, 3) in the tip's frame, ``radius`` (H,) [m]."""
        return dataclasses.replace(
            self,
            link=np.append(self.link, np.full(len(pos), self.chain.tip_index)),
            pos=np.concatenate([self.pos, pos]),
            radius=np.append(self.radius, radius),
            # What is held must not touch the trunk either.
            distal=np.append(self.distal, np.ones(len(pos), dtype=bool)),
        )

    def only(self, links: Sequence[str]) -> RobotSpheres:
        """The spheres of the named links alone.

        Raises:
            ValueError: a name is not among the chain's links.
        """
        keep = np.isin(self.link, [self.chain.links.index(name) for name in links])
        return dataclasses.replace(
            self,
            link=self.link[keep],
            pos=self.pos[keep],
            radius=self.radius[keep],
            distal=self.distal[keep],
        )

    def centers(self, frames: Frames) -> np.ndarray:
        """World positions (N, M, 3) [m] of the spheres' centres at link frames from `Chain.forward`."""
        return frames.pos[:, self.link] + np.einsum(
            "nmij,mj->nmi", frames.rot[:, self.link], self.pos
        )

    def clearance(self, q: np.ndarray, boxes: Boxes) -> np.ndarray:
        """Least distance (N,) [m] of any sphere to any box at configurations ``q`` (N, Q) or (Q,).

        Negative where they overlap; `NOTHING_NEAR_M` without boxes or spheres.
        """
        q = np.atleast_2d(q)
        # The kernel would return infinity, with which differences become NaN.
        if len(q) == 0 or len(boxes) == 0 or len(self.radius) == 0:
            return np.full(len(q), NOTHING_NEAR_M)
        pos, rot = self._frames(q)
        return min_gaps(pos, rot, *self._bounds, *self._by_link, *boxes.contiguous())

    def _frames(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World positions (N, L, 3) and rotations (N, L, 3, 3) of the chain's links."""
        # A copy of one layout, for which the kernel is compiled.
        return link_frames(tree_of(self.chain), np.array(q, np.float64, order="C"))

    @cached_property
    def _by_link(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Spheres sorted by link: first index of each link of `_bounds` (L + 1,), centres (M, 3), radii (M,)."""
        # Stable, so that the spheres of a link keep their order.
        order = np.argsort(self.link, kind="stable")
        first = np.searchsorted(self.link[order], np.unique(self.link))
        return np.append(first, len(order)), self.pos[order], self.radius[order]

    @cached_property
    def _bounds(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bounding sphere of each covered link: link index (L,), centre (L, 3) in the link's frame, radius (L,)."""
        links = np.unique(self.link)
        middle = np.zeros((len(links), 3))
        around = np.zeros(len(links))
        for i, link in enumerate(links):
            mine = self.link == link
            low = (self.pos[mine] - self.radius[mine, None]).min(axis=0)
            high = (self.pos[mine] + self.radius[mine, None]).max(axis=0)
            middle[i] = (low + high) / 2
            around[i] = (
                np.linalg.norm(self.pos[mine] - middle[i], axis=1) + self.radius[mine]
            ).max()
        return links, middle, around

    def self_clearance(self, q: np.ndarray) -> np.ndarray:
        """Least distance (N,) [m] of the distal spheres to the trunk's boxes at configurations ``q`` (N, Q) or (Q,).

        Negative where they overlap; `NOTHING_NEAR_M` without distal spheres or trunk boxes.
        """
        q = np.atleast_2d(q)
        link, points, radius = self._distal
        if not len(link) or not len(self.trunk_link):
            return np.full(len(q), NOTHING_NEAR_M)
        pos, rot = self._frames(q)
        return own_gaps(
            pos, rot, link, points, radius, self.trunk_link, *self._trunk_sides
        )

    @cached_property
    def _distal(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Link, centre and radius of the spheres that `self_clearance` checks."""
        return self.link[self.distal], self.pos[self.distal], self.radius[self.distal]

    @cached_property
    def _trunk_sides(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.trunk.contiguous()


def _cover(geom: Any) -> list[tuple[np.ndarray, float]]:
    """Cover one shape: groups of sphere centres (P, 3) in the link's frame, each group with its radius.

    Thick boxes get a second group of small spheres along their long edges, which large spheres leave uncovered.
    """
    points, size = _fill(geom)
    # Spheres that small leave no edge open that matters.
    if geom.shape != "box" or size <= _THICK_RADIUS_M:
        return [(points, size)]
    half = np.asarray(geom.size, dtype=np.float64)
    span = np.maximum(half - _EDGE_RADIUS_M, 0.0)
    axes = [np.linspace(-r, r, 2 + int(r / _EDGE_RADIUS_M)) for r in span]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    edges = grid[
        # Along the longest side alone: the other edges end in the same corners.
        np.delete(np.abs(grid) >= span - 1e-9, np.argmax(half), axis=1).all(axis=1)
    ]
    rot = mat_from_quat(np.asarray(geom.quat, dtype=np.float64))
    return [
        (points, size),
        (edges @ rot.T + np.asarray(geom.pos, dtype=np.float64), _EDGE_RADIUS_M),
    ]


def _fill(geom: Any) -> tuple[np.ndarray, float]:
    """Centres (P, 3) in the link's frame and common radius [m] of spheres for a box, cylinder, capsule or sphere."""
    if geom.shape == "sphere":
        return np.asarray(geom.pos, dtype=np.float64)[None], float(geom.size[0])
    if geom.shape == "box":
        half = np.asarray(geom.size, dtype=np.float64)
        # Flat boxes get spheres thicker than the box: a small number of spheres matters more than a few millimetres.
        small = max(float(half.min()), 0.7 * float(np.sort(half)[1]))
        local = _grid(np.maximum(half - small, 0.0), small)
    else:
        radius = float(geom.size[0])
        length = float(geom.size[1])
        # A flat disk gets a ring of smaller spheres, or one would stand out of it far above and below.
        small = min(radius, max(length, 0.7 * radius))
        if small == radius:
            local = _grid(np.array([0.0, 0.0, length - small]), small)
        else:
            ring = radius - small
            angle = np.linspace(
                0,
                2 * np.pi,
                max(4, int(np.ceil(2 * np.pi * ring / small))),
                endpoint=False,
            )
            local = np.stack(
                [ring * np.cos(angle), ring * np.sin(angle), 0 * angle], axis=1
            )
            local = np.concatenate([np.zeros((1, 3)), local])
    rot = mat_from_quat(np.asarray(geom.quat, dtype=np.float64))
    return local @ rot.T + np.asarray(geom.pos, dtype=np.float64), small


def _grid(span: np.ndarray, radius: float) -> np.ndarray:
    """Grid of points (P, 3) within ± ``span`` (3,) [m], at most 1.2 ``radius`` apart along each axis."""
    count = [1 + int(np.ceil(2 * r / (1.2 * radius) - 1e-9)) for r in span]
    axes = [
        np.linspace(-r, r, n) if n > 1 else np.zeros(1)
        for r, n in zip(span, count, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _bounding(geoms: Sequence[Any]) -> Boxes:
    """Bounding boxes of primitive shapes, in the frames of the shapes' links."""
    half = []
    for geom in geoms:
        size = np.asarray(geom.size, dtype=np.float64)
        half.append(
            size
            if geom.shape == "box"
            # A sphere has one number, and MuJoCo sets the others to 0.
            else np.array([size[0], size[0], size[1] or size[0]])
        )
    center = np.array([geom.pos for geom in geoms], dtype=np.float64).reshape(-1, 3)
    quat = np.array([geom.quat for geom in geoms], dtype=np.float64).reshape(-1, 4)
    return Boxes(center, np.array(half).reshape(-1, 3), mat_from_quat(quat))
