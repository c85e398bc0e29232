"""Words for the places and the furniture of one home."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjhab.episodes.narration.apart import Landmark, mark
from mjhab.episodes.narration.places import PartWords, TemplateWords, left_of
from mjhab.episodes.zones import receptacle_below
from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import PlacedReceptacle, link_to_open, placed_receptacles
from mjhab.scenes.roles import roles_of
from mjhab.scenes.shapes.footprints import rectangle
from mjhab.scenes.spec import Home, Placement, Vec3
from mjhab.tasks.instructions import Spot, furniture_words

NO_CODE = furniture_words("0")
"""What furniture is called whose id has no words; it is no landmark."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of furniture of a home: its ``thing`` as in `PlacedReceptacle.id`, words, placement and outline.

    ``corners``: (4, 2) [m] in order, world frame; None without colliding geoms. ``blocks``: a robot cannot drive over
    it or pass under it.
    """

    thing: str
    template: str
    words: str
    at: Placement
    corners: np.ndarray | None
    blocks: bool

    @property
    def centre(self) -> np.ndarray:
        """(2,) [m] centre of its outline, or its origin."""
        return np.array(self.at.pos[:2]) if self.corners is None else self.corners.mean(0)

    def may_be(self, words: str) -> bool:
        """Whether words fit it: "table" fits a "dining table", too."""
        return self.words == words or self.words.endswith(f" {words}")


class HomeWords:
    """Words for the places of a home.

    Args:
        layout: layout of the home.
        home: the home.
        templates: words of the parts of every template.

    Attributes:
        receptacles: its receptacles.
        landmarks: pieces of furniture of which the home has one, by template.
    """

    def __init__(
        self, layout: Layout, home: Home, templates: Mapping[str, TemplateWords]
    ) -> None:
        self.receptacles = placed_receptacles(layout, home)
        roles = roles_of(layout.pack, home)
        self._behind: dict[str, list[PlacedReceptacle]] = {}
        for r in self.receptacles:
            self._behind.setdefault(link_to_open(r, roles), []).append(r)
        self._templates = templates
        self._pieces = {piece.thing: piece for piece in _pieces(layout, home, templates)}
        self.landmarks = {
            piece.thing: Landmark(f"the {piece.words}", piece.centre, piece.corners)
            for piece in self._pieces.values()
            if self._alone(piece)
        }
        # Only what holds or opens something is told.
        things = {self._thing(r) for r in self.receptacles}
        things |= {at.template for at in home.articulations}
        self._phrases = {thing: self._phrase(self._pieces[thing]) for thing in things}
        self._spots = self._all_spots()

    # -- places ----------------------------------------------------------------------------------------------------

    def place(self, point: Vec3, link: str = "") -> PlacedReceptacle | None:
        """The receptacle that carries a point [m, world]; ``link``: id of the link behind which it is, if any.

        The receptacle below counts. Drawers may be open while receptacles are where they are with drawers closed: of
        a point behind a link and above no receptacle behind it, the nearest one in height behind it.
        """
        behind = self._behind.get(link, []) if link else []
        if not behind:
            return receptacle_below(point, self.receptacles)
        # An object in an open drawer is above no receptacle of the closed one.
        return receptacle_below(point, behind) or min(
            behind, key=lambda r: abs(point[2] - r.pos[2])
        )

    def spot(self, place: PlacedReceptacle | None) -> Spot:
        """A receptacle in words, which fit no other place of the home."""
        return Spot() if place is None else self._spots[place.id]

    def link(self, link: str) -> str:
        """A link in words, without an article: "top right drawer of the kitchen counter"."""
        furniture, _, name = link.rpartition("/")
        return f"{self._templates[furniture].links[name]} of {self._phrases[furniture]}"

    def left(self, place: PlacedReceptacle | None) -> np.ndarray | None:
        """(2,) unit vector, world frame, to the left of somebody who faces the furniture of a receptacle.

        None for furniture without a front, and without a place.
        """
        if place is None or self._templates[place.template].front is None:
            return None
        front = self._templates[place.template].front
        assert front is not None
        yaw = self._pieces[self._thing(place)].at.yaw
        c = np.cos(yaw)
        s = np.sin(yaw)
        return left_of(
            np.array([c * front[0] - s * front[1], s * front[0] + c * front[1]])
        )

    def landmarks_besides(self, place: PlacedReceptacle | None) -> list[Landmark]:
        """Pieces of furniture from which distances are told, but for the one with a receptacle."""
        own = self._thing(place) if place is not None else ""
        return [found for thing, found in self.landmarks.items() if thing != own]

    @staticmethod
    def _thing(place: PlacedReceptacle) -> str:
        """The piece of furniture of a receptacle."""
        return place.id.rpartition("/")[0]

    # -- words of places -------------------------------------------------------------------------------------------

    def _alone(self, piece: Piece) -> bool:
        """Whether a piece is a landmark: no other fits its words, nor it those of others."""
        others = [other for other in self._pieces.values() if other is not piece]
        return (
            piece.blocks
            and piece.corners is not None
            and piece.words != NO_CODE
            and not any(
                other.may_be(piece.words) or piece.may_be(other.words) for other in others
            )
        )

    def _phrase(self, piece: Piece) -> str:
        """A piece in words that fit no other of the home: "the chair nearest to the fridge"."""
        same = [
            other
            for other in self._pieces.values()
            if other is not piece and other.may_be(piece.words)
        ]
        if not same:
            return f"the {piece.words}"
        points = np.stack([piece.centre, *(other.centre for other in same)])
        found = mark(points, None, (), list(self.landmarks.values()))
        return f"the {piece.words} {found.after if found else ''}".strip()

    def _all_spots(self) -> dict[str, Spot]:
        spots = {r.id: self._plain_spot(r) for r in self.receptacles}
        found: dict[str, Spot] = {}
        for r in self.receptacles:
            same = [
                o for o in self.receptacles if spots[o.id] == spots[r.id] and o is not r
            ]
            found[r.id] = self._part_of(r, same, spots[r.id]) if same else spots[r.id]
        return found

    def _part_of(
        self, place: PlacedReceptacle, same: Sequence[PlacedReceptacle], spot: Spot
    ) -> Spot:
        """Words for one of several receptacles that the same words fit."""
        points = np.array([r.pos[:2] for r in (place, *same)])
        found = mark(points, None, (), self.landmarks_besides(place))
        if found is None:
            return spot
        return replace(spot, words=f"the part of {spot.words} {found.after}")

    def _plain_spot(self, r: PlacedReceptacle) -> Spot:
        named: PartWords = self._templates[r.template].receptacles[r.name]
        whole = self._phrases[self._thing(r)]
        words = f"the {named.part} of {whole}" if named.part else whole
        return Spot(words, named.preposition)


def _pieces(
    layout: Layout, home: Home, templates: Mapping[str, TemplateWords]
) -> list[Piece]:
    """The furniture of a home, in the order of the layout's prop slots, then articulations."""
    slots = zip(layout.prop_slots, layout.slot_placements(home), strict=True)
    placed = [(slot.name, at) for slot, at in slots if at is not None]
    placed += [(at.template, at) for at in home.articulations]
    found = []
    for thing, at in placed:
        prop = layout.pack.props.get(at.template)
        box = templates[at.template].box
        corners = None
        if box is not None:
            (x0, y0), (x1, y1) = box.tolist()
            corners = rectangle(at, (x0, x1), (y0, y1))
        blocks = prop is None or prop.blocks_base
        words = furniture_words(at.template)
        found.append(Piece(thing, at.template, words, at, corners, blocks))
    return found
