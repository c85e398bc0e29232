"""Free space in the present state of a home: clearance of the base on the floor and of the arm in slices of height.

Lengths [m], angles [rad], world frame. Letters: X, Y cells, L slices of height, M arm spheres, N base poses, K boxes.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import distance_transform_edt

from mjhab.core.boxes import Boxes
from mjhab.core.joints import BASE
from mjhab.core.rotations import wrap
from mjhab.envs.parts.world_view import HomeShapes, WorldView
from mjhab.experts.arm import motion
from mjhab.experts.arm.held import held_spheres
from mjhab.experts.base.ajar import planner
from mjhab.experts.base.navigation import Grid

ARM_CLEARANCE_M = 0.02
"""Clearance that the arm needs: it swings a little, and cells are coarse."""
SLICES_M = np.arange(0.7, 1.75, 0.1)
"""Lower ends of the slices of height in which the arm is checked. Below them, the map of the base decides."""
EMPTY_DISTANCE_M = 100.0
"""Distance to the nearest obstacle that is reported where a slice of height is empty. Larger than any home."""
AT_REST_RAD = 0.05
"""Largest distance of a joint from the rest position at which the arm counts as at rest."""
FALLEN_SIZE_M = 0.15
"""Objects that lie below the top of the base, with half sizes below this, are obstacles of the base."""
_STEP = 0.1
"""Height of a slice."""


@dataclass(frozen=True, eq=False)
class Arm:
    """Spheres of the arm and the held object that extend beyond the base, seen from above.

    Attributes:
        offset: (M, 2) centres in the frame of the base.
        radius: (M,) radii plus `ARM_CLEARANCE_M`.
        level: (M, 2) first and last slice of height that each sphere intersects.
    """

    offset: np.ndarray
    radius: np.ndarray
    level: np.ndarray

    @classmethod
    def of(cls, view: WorldView, posture: np.ndarray, held: str = "") -> Arm:
        """Spheres of the arm in configuration ``posture`` (J,) and, where it differs, in the present one.

        Args:
            view: the world.
            posture: (J,) configuration of the arm during the drive.
            held: name of the object in the hand, at its present pose relative to the hand; "" for none.
        """
        robot = motion.arm_spheres(view.robot)
        if held:
            robot = robot.with_held(*held_spheres(view, held))
        q = np.stack(
            [posture, view.q][: 1 if motion.joint_gap(view, posture) < AT_REST_RAD else 2]
        )
        # In the frame of the base, where the arm is the same at every pose.
        q[:, BASE] = 0.0
        center = robot.centers(robot.chain.forward(q)).reshape(-1, 3)
        radius = np.tile(robot.radius, len(q))
        low = np.floor((center[:, 2] - radius - SLICES_M[0]) / _STEP).astype(np.int64)
        high = np.floor((center[:, 2] + radius - SLICES_M[0]) / _STEP).astype(np.int64)
        out = (
            # What is above the base is kept clear by its own map.
            (np.linalg.norm(center[:, :2], axis=1) + radius > view.robot.footprint.wide)
            & (high >= 0)
            & (low < len(SLICES_M))
        )
        level = np.clip(np.stack([low, high], axis=1)[out], 0, len(SLICES_M) - 1)
        return cls(center[out, :2], radius[out] + ARM_CLEARANCE_M, level)


@dataclass(frozen=True, eq=False)
class Floorplan:
    """Free space of a world in its present state, on a grid.

    Attributes:
        origin: (2,) world position of the corner of cell (0, 0).
        cell: edge length of a cell.
        base: (X, Y) clearance at the cells' centres beyond ``needed``.
        free: (L, X, Y) distance to the nearest obstacle in each slice of height.
        sight: (L, X, Y) bool, cells of walls and furniture, which occlude the goal.
        arm: spheres of the arm.
        needed: distance between the base's centre and obstacles that the base needs (`Footprint.wide`).
    """

    origin: np.ndarray
    cell: float
    base: np.ndarray
    free: np.ndarray
    sight: np.ndarray
    arm: Arm
    needed: float

    @classmethod
    def of(
        cls, view: WorldView, arm: Arm, held: str = "", blocks: np.ndarray | None = None
    ) -> Floorplan:
        """Build the floor plan of a world.

        Args:
            view: the world.
            arm: spheres of the arm.
            held: name of the object in the hand, which is no obstacle.
            blocks: (B, 3) x, y, radius of places where the robot touched an unknown obstacle.
        """
        cells = planner(view)
        # Before objects and doors are drawn: they do not block the view for long.
        sight = _solid(view.home)
        solid = sight.copy()
        objects = view.object_boxes((held,))
        _draw(
            solid,
            Boxes.join([view.link_boxes(), objects]),
            cells.origin,
            cells.cell,
        )
        base = cells.clearance
        height = objects.center[:, 2]
        # Objects that an episode does not use are parked below the floor.
        low = objects.take(
            (height > -0.1)
            & (height < view.robot.footprint.top)
            # Larger things on the floor are furniture of the map.
            & (objects.half.max(axis=1) < FALLEN_SIZE_M)
        )
        felt = (
            np.zeros((0, 3))
            if blocks is None
            else np.asarray(blocks, float).reshape(-1, 3)
        )
        if len(low) or len(felt):
            fallen = np.column_stack([low.center[:, :2], low.half[:, :2].max(axis=1)])
            spots = np.concatenate([fallen, felt])
            centers = cells.grid.centres
            gap = np.linalg.norm(centers[:, :, None] - spots[:, :2], axis=-1)
            gap = gap - spots[:, 2]
            base = np.minimum(base, np.maximum(gap.min(axis=-1), 0.0))
            solid |= (gap[..., len(fallen) :] < 0.0).any(axis=-1)
        free = np.stack([_distance(level, cells.cell) for level in solid])
        needed = view.robot.footprint.wide
        return cls(cells.origin, cells.cell, base - needed, free, sight, arm, needed)

    def slimmer(self, base: float, arm: float) -> Floorplan:
        """The floor plan for smaller safety margins: ``base`` and ``arm`` [m] are subtracted from their clearances."""
        less = dataclasses.replace(
            self.arm, radius=np.maximum(self.arm.radius - arm, 0.0)
        )
        return dataclasses.replace(self, base=self.base + base, arm=less)

    def clearance(self, poses: np.ndarray) -> np.ndarray:
        """Clearance (N,) of base and arm beyond what they need at base poses (N, 3); negative: too close."""
        poses = np.atleast_2d(poses)
        found = self._at(self.base, poses[:, :2], -self.needed)
        cos = np.cos(poses[:, 2, None])
        sin = np.sin(poses[:, 2, None])
        x = poses[:, 0, None] + cos * self.arm.offset[:, 0] - sin * self.arm.offset[:, 1]
        y = poses[:, 1, None] + sin * self.arm.offset[:, 0] + cos * self.arm.offset[:, 1]
        points = np.stack([x, y], axis=-1)
        for rows, free in self._groups:
            gap = self._at(free, points[:, rows], 0.0) - self.arm.radius[rows]
            found = np.minimum(found, gap.min(axis=1, initial=np.inf))
        return found

    def turning(self, xy: np.ndarray, start: float, turn: float) -> float:
        """Least `clearance` during a turn on the spot at ``xy`` (2,) from heading ``start`` by ``turn`` (signed)."""
        yaw = start + np.linspace(0.0, turn, 2 + int(abs(turn) / 0.1))
        return float(
            self.clearance(
                np.column_stack([np.full(len(yaw), xy[0]), np.full(len(yaw), xy[1]), yaw])
            ).min()
        )

    def clearances(self, yaws: np.ndarray) -> np.ndarray:
        """`clearance` (H, X, Y) at all cells' centres for headings (H,); arm spheres are rounded to whole cells."""
        pad = 1 + int(
            np.ceil(
                float(np.linalg.norm(self.arm.offset, axis=1).max(initial=0.0))
                / self.cell
            )
        )
        nx, ny = self.base.shape
        out = np.repeat(self.base[None], len(yaws), axis=0)
        for rows, free in self._groups:
            # Outside of the map is no room, and shifts need no bounds.
            padded = np.pad(free, pad)
            for layer, yaw in zip(out, yaws, strict=True):
                cos = np.cos(yaw)
                sin = np.sin(yaw)
                shift = np.rint(
                    self.arm.offset[rows]
                    @ np.array([[cos, sin], [-sin, cos]])
                    / self.cell
                ).astype(int)
                widest: dict[tuple[int, int], float] = {}
                for (i, j), radius in zip(
                    shift.tolist(), self.arm.radius[rows].tolist(), strict=True
                ):
                    # Many spheres fall into one cell; only the widest counts.
                    widest[i, j] = max(widest.get((i, j), 0.0), radius)
                for (i, j), radius in widest.items():
                    np.minimum(
                        layer,
                        padded[pad + i : pad + i + nx, pad + j : pad + j + ny] - radius,
                        out=layer,
                    )
        return out

    def hidden(self, points: np.ndarray, goal: np.ndarray, near: float) -> np.ndarray:
        """Share (N,) of the lines of sight from ``points`` (N, 2) to ``goal`` (3,) inside walls or furniture.

        The lines run in the slice 0.15 m above the goal; their last ``near`` [m] do not count.
        """
        level = self.sight[
            int(np.clip((goal[2] + 0.15 - SLICES_M[0]) / _STEP, 0, len(SLICES_M) - 1))
        ]
        offset = goal[:2] - points
        far = np.linalg.norm(offset, axis=1)
        share = np.linspace(0.0, 1.0, 24)[:, None] * np.clip(
            1.0 - near / np.maximum(far, 1e-9), 0.0, 1.0
        )
        i, j = self.grid.cells(points + share[..., None] * offset)
        return level[i, j].mean(axis=0)

    @property
    def grid(self) -> Grid:
        """The cells of the map."""
        return Grid(self.origin, self.cell, self.base.shape)

    def _at(self, values: np.ndarray, points: np.ndarray, outside: float) -> np.ndarray:
        """Bilinear interpolation (...,) of ``values`` (X, Y) at points (..., 2); ``outside`` beyond the map."""
        at = (points - self.origin) / self.cell - 0.5
        last = np.array(values.shape) - 1
        inside = ((at >= 0) & (at <= last)).all(axis=-1)
        low = np.clip(np.floor(at).astype(np.int64), 0, last - 1)
        i = low[..., 0]
        j = low[..., 1]
        (u, v) = np.moveaxis(at - low, -1, 0)
        near = (1 - v) * values[i, j] + v * values[i, j + 1]
        far = (1 - v) * values[i + 1, j] + v * values[i + 1, j + 1]
        return np.where(inside, (1 - u) * near + u * far, outside)

    @cached_property
    def _groups(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Groups of spheres that intersect the same slices: indices, and least distances (X, Y) over these slices."""
        kinds, which = np.unique(self.arm.level, axis=0, return_inverse=True)
        return [
            (np.flatnonzero(which.ravel() == k), self.free[low : high + 1].min(axis=0))
            for k, (low, high) in enumerate(kinds.tolist())
        ]


def _solid(home: HomeShapes) -> np.ndarray:
    """Cells (L, X, Y) bool of walls and furniture, without doors and drawers. Read-only."""
    return home.derived.get("solid", lambda: _find_solid(home))


def _find_solid(home: HomeShapes) -> np.ndarray:
    solid = np.zeros((len(SLICES_M), *home.map_clearance.shape), bool)
    _draw(solid, home.boxes, home.map_origin, home.map_cell)
    # It is kept for the home, and callers draw into copies.
    solid.flags.writeable = False
    return solid


def _distance(taken: np.ndarray, cell: float) -> np.ndarray:
    """Distance (X, Y) from the cells' centres to the nearest of the cells ``taken`` (X, Y) bool."""
    # The transform is undefined without a taken cell.
    if not taken.any():
        return np.full(taken.shape, EMPTY_DISTANCE_M)
    # From the middle of a free cell to the edge of the taken one.
    return np.maximum(np.asarray(distance_transform_edt(~taken)) * cell - cell / 2, 0.0)


def _draw(solid: np.ndarray, boxes: Boxes, origin: np.ndarray, cell: float) -> None:
    """Mark in ``solid`` (L, X, Y) bool the cells whose centres are inside a box or less than half a cell beside it."""
    reach = np.einsum("kij,kj->ki", np.abs(boxes.rot), boxes.half)
    low = np.floor(
        (boxes.center - reach - [*origin, SLICES_M[0]]) / [cell, cell, _STEP]
    ).astype(int)
    high = (
        np.floor(
            (boxes.center + reach - [*origin, SLICES_M[0]]) / [cell, cell, _STEP]
        ).astype(int)
        + 1
    )
    top = np.array([*solid.shape[1:], len(SLICES_M)])
    low = np.clip(low, 0, top)
    high = np.clip(high, 0, top)
    for k in np.flatnonzero((high > low).all(axis=1)):
        (i, j, a) = low[k]
        (m, n, b) = high[k]
        at = origin + (np.moveaxis(np.mgrid[i:m, j:n], 0, -1) + 0.5) * cell
        # An upright box is rotated about the vertical alone; a leaning one is replaced by its bounding rectangle.
        local = (at - boxes.center[k, :2]) @ boxes.rot[k, :2, :2]
        leaning = abs(boxes.rot[k, 2, 2]) < 0.99
        inside = (
            np.abs(local) <= (np.inf if leaning else boxes.half[k, :2] + cell / 2)
        ).all(axis=-1)
        solid[a:b, i:m, j:n] |= inside


def turn_between(start: float, end: float) -> float:
    """The shorter turn from one heading to another, in [-pi, pi)."""
    return float(wrap(end - start))
