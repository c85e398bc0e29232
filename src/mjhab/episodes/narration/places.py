"""Words for receptacles, drawers and doors, from the geometry of their furniture: "the top right drawer".

Numbers and names of a template's parts mean nothing to a reader, so that a part is named by where it is. Left and
right are as seen by somebody who stands before the front of the furniture and faces it; rows are counted from the top.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.scenes.shapes.footprints import outline
from mjhab.scenes.spec import Articulation, Geom, Link, Prop, Receptacle
from mjhab.tasks.instructions import plain_words

ROW_GAP_M = 0.08
"""Parts of a piece of furniture whose centres are nearer upwards [m] are in one row."""
BASINS = ("sink", "basin", "tub")
"""Receptacles of these names are named, and things lie in them."""
_ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth")
LINK_NOUNS = (
    "drawer",
    "door",
    "lid",
    "flap",
    "hatch",
    "tray",
    "basket",
    "rack",
    "gate",
    "window",
)
"""Words for what opens, looked for in the names of links."""


@dataclass(frozen=True)
class PartWords:
    """How a part of a piece of furniture is called.

    Attributes:
        preposition: "in" or "on".
        part: "top right drawer", "" for the furniture as a whole.
    """

    preposition: str
    part: str


@dataclass(frozen=True)
class _PlacePart:
    """A part with its noun, its centre (3,) and its horizontal half-extents (2,) [m] in the frame of the template."""

    name: str
    noun: str
    centre: np.ndarray
    half: np.ndarray

    def across(self, left: np.ndarray) -> tuple[float, float]:
        """Its extent [m] to the right of the template's origin: least and greatest."""
        # To the right, so that ascending order is that of reading.
        middle = -float(self.centre[:2] @ left)
        half = float(self.half @ np.abs(left))
        return middle - half, middle + half


class TemplateWords:
    """Words for the parts of one template.

    Args:
        template: the piece of furniture.
        meshes: meshes of the pack by name.

    Attributes:
        front: (2,) horizontal unit vector out of the front, template frame; None for furniture without moving parts,
            whose front cannot be told.
        links: words of every link by name: "top right drawer".
        receptacles: words of every receptacle by name.
        box: (2, 2) lower and upper x, y [m] of its geoms, template frame; None without geoms.
    """

    def __init__(
        self, template: Prop | Articulation, meshes: Mapping[str, object]
    ) -> None:
        links = template.links if isinstance(template, Articulation) else ()
        self.front = _front(links)
        self.box = _plan_box(template.geoms, meshes)
        origins = {link.name: np.array(link.pos) for link in links}
        parts = [_link_part(link, meshes) for link in links]
        self.links = self._placed(parts)
        self.receptacles = self._receptacles(template.receptacles, origins)

    def _receptacles(
        self, receptacles: Sequence[Receptacle], origins: Mapping[str, np.ndarray]
    ) -> dict[str, PartWords]:
        found: dict[str, PartWords] = {}
        groups: dict[str, list[_PlacePart]] = {"shelf": [], "open": []}
        for r in receptacles:
            basin = next((word for word in BASINS if word in plain_words(r.name)), "")
            if r.kind == "drawer" and r.link in self.links:
                found[r.name] = PartWords("in", self.links[r.link])
            elif basin:
                found[r.name] = PartWords("in", basin)
            else:
                kind = "open" if r.kind == "open" else "shelf"
                # A receptacle of a link is given in the frame of that link.
                origin = origins.get(r.link, np.zeros(3))
                at = origin + np.array(r.pos)
                groups[kind].append(_PlacePart(r.name, kind, at, np.array(r.half)))
        for name, words in self._placed(groups["shelf"]).items():
            found[name] = PartWords("on", words)
        for name, words in self._placed(groups["open"]).items():
            where = words.removesuffix("open").strip()
            found[name] = PartWords("on", f"{where} part" if where else "")
        return found

    def _placed(self, parts: Sequence[_PlacePart]) -> dict[str, str]:
        """Words of parts by name: the noun with what tells it from others of the same noun."""
        words: dict[str, str] = {}
        # A dict instead of a set, because the order of a set of strings differs between runs.
        for noun in dict.fromkeys(part.noun for part in parts):
            group = [part for part in parts if part.noun == noun]
            columns = self._columns(group)
            for rank, column in enumerate(columns):
                side = side_word(rank, len(columns))
                rows = _rows(column)
                for level, row in enumerate(rows):
                    where = _both(level_word(level, len(rows)), side)
                    words |= {part.name: f"{where} {noun}".strip() for part in row}
        return words

    def _columns(self, parts: Sequence[_PlacePart]) -> list[list[_PlacePart]]:
        """Parts that are above one another, from left to right: of two, half of the narrower one at least."""
        if self.front is None:
            return [list(parts)]
        left = left_of(self.front)
        columns: list[list[_PlacePart]] = []
        for part in sorted(parts, key=lambda part: ordered_sum(part.across(left))):
            # Compared with the first of the column: chained overlaps could join parts side by side.
            if columns and _overlap(part.across(left), columns[-1][0].across(left)):
                columns[-1].append(part)
            else:
                columns.append([part])
        return columns


def left_of(front: np.ndarray) -> np.ndarray:
    """(2,) unit vector to the left of somebody who faces furniture with a ``front`` (2,) pointing to him."""
    return np.array([front[1], -front[0]])


def level_word(rank: int, count: int) -> str:
    """The ``rank``-th of ``count`` rows from the top: "top", "second highest", "" for the only one."""
    if count == 1:
        return ""
    if rank in (0, count - 1):
        return "bottom" if rank else "top"
    if count == 3:
        return "middle"
    if rank < count / 2:
        return f"{_ordinal(rank + 1)} highest"
    return f"{_ordinal(count - rank)} lowest"


def side_word(rank: int, count: int) -> str:
    """The ``rank``-th of ``count`` columns from the left: "left", "middle", "right", "" for the only one."""
    if count == 1:
        return ""
    if count == 2:
        return ("left", "right")[rank]
    if count == 3:
        return ("left", "middle", "right")[rank]
    if rank in (0, count - 1):
        return "rightmost" if rank else "leftmost"
    return f"{_ordinal(rank + 1)}-from-left"


def _both(level: str, side: str) -> str:
    # "Middle middle" is no English.
    if level == side == "middle":
        return "central"
    return f"{level} {side}".strip()


def _ordinal(number: int) -> str:
    return _ORDINALS[number - 1] if number <= len(_ORDINALS) else f"{number}th"


def _rows(parts: Sequence[_PlacePart]) -> list[list[_PlacePart]]:
    """Parts by height, the highest first."""
    rows: list[list[_PlacePart]] = []
    for part in sorted(parts, key=lambda part: -part.centre[2]):
        # Compared with the last of the row, so that parts of slightly falling heights stay one row.
        if rows and rows[-1][-1].centre[2] - part.centre[2] <= ROW_GAP_M:
            rows[-1].append(part)
        else:
            rows.append([part])
    return rows


def _overlap(a: tuple[float, float], b: tuple[float, float]) -> bool:
    common = min(a[1], b[1]) - max(a[0], b[0])
    return common > 0.5 * min(a[1] - a[0], b[1] - b[0])


def _front(links: Sequence[Link]) -> np.ndarray | None:
    if not links:
        return None
    out = np.sum([link.handle.out[:2] for link in links], axis=0)
    length = float(np.linalg.norm(out, axis=-1))
    # Handles that point to all sides cancel out: such furniture has no front.
    return out / length if length > 0.5 else None


def _link_noun(link: Link) -> str:
    """What a link is: the word of its name that says it, else "drawer" or "door"."""
    named = re.findall(r"[a-z]+", plain_words(link.name))
    usual = "drawer" if link.joint == "slide" else "door"
    return next((word for word in named if word in LINK_NOUNS), usual)


def _link_part(link: Link, meshes: Mapping[str, object]) -> _PlacePart:
    points = np.concatenate([outline(geom, meshes) for geom in link.geoms])
    low = points.min(0)
    high = points.max(0)
    centre = np.array(link.pos) + (low + high) / 2
    return _PlacePart(link.name, _link_noun(link), centre, (high - low)[:2] / 2)


def _plan_box(geoms: Sequence[Geom], meshes: Mapping[str, object]) -> np.ndarray | None:
    solid = [geom for geom in geoms if geom.collide]
    if not solid:
        return None
    points = np.concatenate([outline(geom, meshes)[:, :2] for geom in solid])
    return np.stack([points.min(0), points.max(0)])
