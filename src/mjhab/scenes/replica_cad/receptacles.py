"""Receptacles of ReplicaCAD: boxes of space in its configs, brought onto the surfaces that carry the objects.

The boxes of the data set are drawn by hand: they end above or below the surface and reach past its edges (the fridge's
by 10 cm behind the shelf). Each becomes the largest rectangle inside it under which there is one flat surface and over
which there is room.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mjhab.core.errors import UsageError, shown
from mjhab.scenes.replica_cad.files import PREFIX, numbers, point
from mjhab.scenes.shapes.hulls import vertical_extent
from mjhab.scenes.spec import Receptacle

MAX_FREE_HEIGHT_M = 0.6
"""Free height [m] given to surfaces with nothing above."""
_CELLS_PER_SIDE = 27
_MAX_UNEVENNESS_M = 0.008
"""Largest unevenness of a surface [m]."""
_MAX_DROP_M = 0.10
"""How far below its box a surface may be [m]."""
_MIN_HEIGHT_SHARE = 0.6
"""Where there is less than this share of the usual height above a surface, something hangs over it."""
_KEY_PREFIX = "receptacle_aabb_"


@dataclass(frozen=True, eq=False)
class Space:
    """A box of a config in our template frame: centre (3,) and half-extents (3,) [m], owner link or ""."""

    name: str
    center: np.ndarray
    half: np.ndarray
    link: str


def spaces(
    path: Path, body: dict[str, Any], frames: dict[str, np.ndarray], scale: float = 1.0
) -> list[Space]:
    """The receptacle boxes of a config.

    Args:
        path, body: the config.
        frames: pose (4, 4) in our template frame of the object ("") or of its links by name.
        scale: of the object.

    Raises:
        UsageError: a field does not fit; names it.
    """
    found = []
    given = body.get("user_defined", {})
    if not isinstance(given, dict):
        raise UsageError(f"{path}: field 'user_defined': expected an object, got {shown(given)}.")
    for key, record in given.items():
        if not key.startswith(_KEY_PREFIX):
            continue
        where = f"user_defined.{key}"
        link = record.get("parent_link", "") if isinstance(record, dict) else ""
        if not isinstance(link, str) or link not in frames:
            continue
        pose = frames[link]
        center = pose[:3, :3] @ (scale * numbers(path, record, "position", 3, where)) + pose[:3, 3]
        # A few half-extents of the data set are negative.
        half = np.abs(numbers(path, record, "scale", 3, where))
        half = scale * np.abs(np.round(pose[:3, :3])) @ half
        found.append(Space(_name(key, record), center, half, link))
    return found


def _name(key: str, record: dict[str, Any]) -> str:
    """Name of a receptacle: that of the data set without the name of the object, in lower case."""
    owner = re.escape(str(record.get("parent_object", "")))
    return re.sub(rf"_?({PREFIX})?{owner}$", "", key.removeprefix(_KEY_PREFIX)).lower()


def fit(
    space: Space, pieces: Sequence[np.ndarray], link: str = "", origin: np.ndarray | None = None
) -> Receptacle | None:
    """The receptacle of a box of space.

    Args:
        space: the box.
        pieces: convex pieces (P, 3) of the furniture in the template frame, closed.
        link: the moving link that carries it, or "".
        origin: (3,) origin of that link in the template frame.

    Returns:
        None when nothing flat is under the box.
    """
    cells = [
        space.center[k]
        + space.half[k] * (2 * (np.arange(_CELLS_PER_SIDE) + 0.5) / _CELLS_PER_SIDE - 1)
        for k in (0, 1)
    ]
    xy = np.stack(np.meshgrid(*cells, indexing="ij"), axis=-1).reshape(-1, 2)
    surface, ceiling = _levels(space, pieces, xy)
    known = np.isfinite(surface)
    if known.mean() < 0.1:
        return None
    level = _usual(surface[known])
    room = np.minimum(ceiling - level, MAX_FREE_HEIGHT_M)
    good = known & (np.abs(surface - level) < _MAX_UNEVENNESS_M)
    if not good.any():
        return None
    good &= room >= _MIN_HEIGHT_SHARE * np.median(room[good])
    i0, i1, j0, j1 = largest_rectangle(good.reshape(_CELLS_PER_SIDE, _CELLS_PER_SIDE))
    step = space.half[:2] / _CELLS_PER_SIDE
    # The middle of the last good cell is on the surface for sure; only at the end of the box its border is.
    last = _CELLS_PER_SIDE - 1
    low = np.array([cells[0][i0], cells[1][j0]]) - step * [i0 == 0, j0 == 0]
    high = np.array([cells[0][i1], cells[1][j1]]) + step * [i1 == last, j1 == last]
    inside = room.reshape(_CELLS_PER_SIDE, _CELLS_PER_SIDE)[i0 : i1 + 1, j0 : j1 + 1]
    center = np.append((low + high) / 2, level) - (np.zeros(3) if origin is None else origin)
    u, v = ((high - low) / 2).tolist()
    height = float(inside.min())
    kind: Literal["open", "drawer", "shelf"] = (
        "drawer" if link else "shelf" if height < MAX_FREE_HEIGHT_M else "open"
    )
    return Receptacle(space.name, point(center), (u, v), height, kind, link)


def _levels(
    space: Space, pieces: Sequence[np.ndarray], xy: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Height of the surface (N,) below the middle of the box (-inf: none) and of what is above (inf: nothing)."""
    middle = space.center[2]
    bottom = space.center[2] - space.half[2]
    surface = np.full(len(xy), -np.inf)
    ceiling = np.full(len(xy), np.inf)
    first = xy.min(0)
    last = xy.max(0)
    for piece in pieces:
        if np.any(piece[:, :2].max(0) < first) or np.any(piece[:, :2].min(0) > last):
            continue
        low, high = vertical_extent(piece, xy)
        below = high <= middle
        surface = np.where(below, np.maximum(surface, high), surface)
        ceiling = np.where(~below, np.minimum(ceiling, low), ceiling)
    surface = np.where((surface > bottom - _MAX_DROP_M) & (ceiling > surface), surface, -np.inf)
    return surface, ceiling


def _usual(levels: np.ndarray) -> float:
    """The level around which most of the values lie."""
    order = np.sort(levels)
    count = np.searchsorted(order, order + _MAX_UNEVENNESS_M, side="right") - np.arange(len(order))
    first = int(count.argmax())
    return float(np.median(order[first : first + int(count[first])]))


def largest_rectangle(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Rows i0..i1 and columns j0..j1 (inclusive) of the largest rectangle of True cells of a (R, C) mask."""
    best = 0
    found = (0, mask.shape[0] - 1, 0, mask.shape[1] - 1)
    for i0 in range(mask.shape[0]):
        column = np.ones(mask.shape[1], bool)
        for i1 in range(i0, mask.shape[0]):
            column = column & mask[i1]
            if not column.any():
                break
            if int(column.sum()) * (i1 - i0 + 1) <= best:
                continue
            edges = np.flatnonzero(np.diff(np.concatenate([[0], column, [0]])))
            runs = edges[1::2] - edges[::2]
            k = int(runs.argmax())
            if int(runs[k]) * (i1 - i0 + 1) > best:
                best = int(runs[k]) * (i1 - i0 + 1)
                found = (i0, i1, int(edges[2 * k]), int(edges[2 * k + 1]) - 1)
    return found
