"""Receptacles of ReplicaCAD: boxes of space in its configs, fitted to the surfaces that support objects.

The boxes of the data set are drawn by hand: they end above or below the surface and extend past its edges (the fridge's
by 10 cm behind the shelf). Each is replaced by the largest rectangle inside it that has one flat surface below and free
height above.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mjhab.core.errors import wrong_value
from mjhab.scenes.replica_cad.files import PREFIX, numbers, point
from mjhab.scenes.shapes.hulls import vertical_extent
from mjhab.scenes.spec import Receptacle

MAX_FREE_HEIGHT_M = 0.6
"""Free height [m] given to surfaces with nothing above."""
_CELLS_PER_SIDE = 27
"""Cells per side of the grid on which a box is sampled."""
_MAX_UNEVENNESS_M = 0.008
"""Largest difference in height from the level of a surface [m]."""
_MAX_DROP_M = 0.10
"""Largest distance of a surface below the bottom of its box [m]."""
_MIN_HEIGHT_SHARE = 0.6
"""Cells with less than this fraction of the median free height are excluded, because something hangs over them."""
_KEY_PREFIX = "receptacle_aabb_"


@dataclass(frozen=True, eq=False)
class ConfigBox:
    """A box of a config in our template frame: centre (3,) and half-extents (3,) [m], owner link or ""."""

    name: str
    center: np.ndarray
    half: np.ndarray
    link: str


def spaces(
    path: Path, body: dict[str, Any], frames: dict[str, np.ndarray], scale: float = 1.0
) -> list[ConfigBox]:
    """Read the receptacle boxes of a config.

    Args:
        path, body: file and content of the config.
        frames: pose (4, 4) in our template frame of the object ("") or of its links, by name; boxes of other links are
            left out.
        scale: uniform scale of the object.

    Raises:
        UsageError: a field is missing or of the wrong type; the message names it.
    """
    found = []
    given = body.get("user_defined", {})
    if not isinstance(given, dict):
        raise wrong_value("user_defined", given, "an object", where=path)
    for key, record in given.items():
        if not key.startswith(_KEY_PREFIX):
            continue
        where = f"user_defined.{key}"
        link = record.get("parent_link", "") if isinstance(record, dict) else ""
        # Boxes of links that a version of the URDF lacks are of no use.
        if not isinstance(link, str) or link not in frames:
            continue
        pose = frames[link]
        center = (
            pose[:3, :3] @ (scale * numbers(path, record, "position", 3, where))
            + pose[:3, 3]
        )
        # A few half-extents of the data set are negative.
        half = np.abs(numbers(path, record, "scale", 3, where))
        # Rounded, because boxes along axes stay boxes only under quarter turns.
        half = scale * np.abs(np.round(pose[:3, :3])) @ half
        found.append(ConfigBox(_name(key, record), center, half, link))
    return found


def _name(key: str, record: dict[str, Any]) -> str:
    """Name of a receptacle: that in the data set without the name of the object, in lower case."""
    owner = re.escape(str(record.get("parent_object", "")))
    return re.sub(rf"_?({PREFIX})?{owner}$", "", key.removeprefix(_KEY_PREFIX)).lower()


def fit(
    space: ConfigBox,
    pieces: Sequence[np.ndarray],
    link: str = "",
    origin: np.ndarray | None = None,
) -> Receptacle | None:
    """Fit a receptacle to a box of space.

    Args:
        space: the box.
        pieces: points (P, 3) [m] of the convex collision pieces of the furniture in the template frame, joints closed.
        link: name of the moving link that carries the receptacle, or "".
        origin: (3,) origin of that link in the template frame [m].

    Returns:
        The receptacle, in the frame of the link or the template; None if there is no flat surface below the box.
    """
    cells = [
        space.center[k]
        + space.half[k] * (2 * (np.arange(_CELLS_PER_SIDE) + 0.5) / _CELLS_PER_SIDE - 1)
        for k in (0, 1)
    ]
    # Centres of cells: points on the edge of a box may miss a surface that ends there.
    xy = np.stack(np.meshgrid(*cells, indexing="ij"), axis=-1).reshape(-1, 2)
    surface, ceiling = _levels(space, pieces, xy)
    known = np.isfinite(surface)
    if known.mean() < 0.1:
        return None
    level = _usual(surface[known])
    # Without a ceiling the height would be infinite.
    headroom = np.minimum(ceiling - level, MAX_FREE_HEIGHT_M)
    good = known & (np.abs(surface - level) < _MAX_UNEVENNESS_M)
    if not good.any():
        return None
    good &= headroom >= _MIN_HEIGHT_SHARE * np.median(headroom[good])
    i0, i1, j0, j1 = largest_rectangle(good.reshape(_CELLS_PER_SIDE, _CELLS_PER_SIDE))
    step = space.half[:2] / _CELLS_PER_SIDE
    # Only the centres of cells are known to be on the surface, except at the edges of the box, which are kept.
    last = _CELLS_PER_SIDE - 1
    low = np.array([cells[0][i0], cells[1][j0]]) - step * [i0 == 0, j0 == 0]
    high = np.array([cells[0][i1], cells[1][j1]]) + step * [i1 == last, j1 == last]
    inside = headroom.reshape(_CELLS_PER_SIDE, _CELLS_PER_SIDE)[i0 : i1 + 1, j0 : j1 + 1]
    center = np.append((low + high) / 2, level) - (
        np.zeros(3) if origin is None else origin
    )
    u, v = ((high - low) / 2).tolist()
    height = float(inside.min())
    kind: Literal["open", "drawer", "shelf"] = (
        "drawer" if link else "shelf" if height < MAX_FREE_HEIGHT_M else "open"
    )
    return Receptacle(space.name, point(center), (u, v), height, kind, link)


def _levels(
    space: ConfigBox, pieces: Sequence[np.ndarray], xy: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Heights (N,) [m] at points ``xy`` (N, 2) of the surface and of the ceiling.

    The surface is the highest below the middle of the box, or -inf; the ceiling is the lowest above it, or inf.
    """
    middle = space.center[2]
    bottom = space.center[2] - space.half[2]
    surface = np.full(len(xy), -np.inf)
    ceiling = np.full(len(xy), np.inf)
    first = xy.min(0)
    last = xy.max(0)
    for piece in pieces:
        # Most pieces of furniture are elsewhere, and an intersection costs a hull each.
        if np.any(piece[:, :2].max(0) < first) or np.any(piece[:, :2].min(0) > last):
            continue
        low, high = vertical_extent(piece, xy)
        # The middle of the box is in free space, even where its ends are not.
        below = high <= middle
        surface = np.where(below, np.maximum(surface, high), surface)
        ceiling = np.where(~below, np.minimum(ceiling, low), ceiling)
    surface = np.where(
        (surface > bottom - _MAX_DROP_M) & (ceiling > surface), surface, -np.inf
    )
    return surface, ceiling


def _usual(levels: np.ndarray) -> float:
    """Median of the largest group of values that lie within `_MAX_UNEVENNESS_M`."""
    order = np.sort(levels)
    count = np.searchsorted(order, order + _MAX_UNEVENNESS_M, side="right") - np.arange(
        len(order)
    )
    first = int(count.argmax())
    return float(np.median(order[first : first + int(count[first])]))


def largest_rectangle(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Find the largest rectangle of True cells in a mask (R, C).

    Returns:
        First and last row, first and last column (inclusive).
    """
    best = 0
    found = (0, mask.shape[0] - 1, 0, mask.shape[1] - 1)
    for i0 in range(mask.shape[0]):
        column = np.ones(mask.shape[1], bool)
        for i1 in range(i0, mask.shape[0]):
            column = column & mask[i1]
            if not column.any():
                break
            # Cannot become the largest: the runs of the row are not looked at.
            if int(column.sum()) * (i1 - i0 + 1) <= best:
                continue
            edges = np.flatnonzero(np.diff(np.concatenate([[0], column, [0]])))
            runs = edges[1::2] - edges[::2]
            k = int(runs.argmax())
            if int(runs[k]) * (i1 - i0 + 1) > best:
                best = int(runs[k]) * (i1 - i0 + 1)
                found = (i0, i1, int(edges[2 * k]), int(edges[2 * k + 1]) - 1)
    return found
