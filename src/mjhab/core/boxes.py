"""Sets of oriented boxes and distances to them, in batches. Lengths [m], world frame. Letters: P points, K boxes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mjhab.core.kernels.arrays import read_only


@dataclass(frozen=True, eq=False)
class Boxes:
    """Oriented boxes: ``center`` (K, 3), ``half`` (K, 3) half-extents, ``rot`` (K, 3, 3) with the axes as columns."""

    center: np.ndarray
    half: np.ndarray
    rot: np.ndarray

    def __len__(self) -> int:
        return len(self.center)

    @staticmethod
    def of(center: ArrayLike, half: ArrayLike, rot: ArrayLike | None = None) -> Boxes:
        """Boxes from anything array-like; ``rot`` None: along the axes of the world."""
        center = np.asarray(center, dtype=np.float64).reshape(-1, 3)
        # numpy cannot broadcast the half-extents of one box to none.
        if not len(center):
            return Boxes.join(())
        half = np.broadcast_to(np.asarray(half, dtype=np.float64), center.shape)
        turn = np.eye(3) if rot is None else np.asarray(rot, dtype=np.float64)
        return Boxes(center, half, np.broadcast_to(turn, (len(center), 3, 3)))

    @staticmethod
    def join(parts: Iterable[Boxes]) -> Boxes:
        """All boxes of several sets in one."""
        sets = [part for part in parts if len(part)]
        if not sets:
            return Boxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
        return Boxes(
            *(
                np.concatenate([getattr(s, k) for s in sets])
                for k in ("center", "half", "rot")
            )
        )

    def contiguous(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``center``, ``half`` and ``rot`` as compiled kernels take them."""
        return read_only(self.center), read_only(self.half), read_only(self.rot)

    def take(self, keep: np.ndarray) -> Boxes:
        """The boxes picked by an index or mask."""
        return Boxes(self.center[keep], self.half[keep], self.rot[keep])

    def near(self, point: np.ndarray, reach: float) -> Boxes:
        """The boxes that come within ``reach`` of ``point`` (3,) or, for (2,), of the vertical line through it."""
        point = np.asarray(point, dtype=np.float64)
        if point.shape == (3,):
            gap = sphere_box_distance(point[None], self)[0] if len(self) else np.zeros(0)
        else:
            gap = np.linalg.norm(self.center[:, :2] - point, axis=1) - np.linalg.norm(
                self.half, axis=1
            )
        return self.take(gap <= reach)


def sphere_box_distance(points: np.ndarray, boxes: Boxes) -> np.ndarray:
    """Signed distances (P, K) of points (P, 3) to boxes: negative inside, exact outside."""
    count = len(boxes)
    # One matrix product takes every point into every box's frame.
    turn = boxes.rot.transpose(1, 0, 2).reshape(3, count * 3)
    shift = np.einsum("ki,kij->kj", boxes.center, boxes.rot)
    local = np.abs((points @ turn).reshape(len(points), count, 3) - shift) - boxes.half
    outside = np.maximum(local, 0.0)
    inside = np.minimum(np.max(local, axis=2), 0.0)
    # One of the two is 0 for every point, so that their sum is the signed distance.
    return np.sqrt(np.einsum("pkc,pkc->pk", outside, outside)) + inside


def nearest_box_distance(points: np.ndarray, boxes: Boxes) -> np.ndarray:
    """Signed distance (P,) of each of ``points`` (P, 3) to the box nearest to it; infinite without boxes."""
    # Here, because boxes are also used where nothing else needs numba.
    from mjhab.core.kernels.box_gaps import least_box_gaps  # loads numba

    return least_box_gaps(read_only(points), *boxes.contiguous())
