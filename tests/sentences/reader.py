"""Reads instructions back and holds them against the state of the simulator.

Nothing of the code that writes sentences is used: the grammar and the lexicon are here, and what is true comes from the
geoms of MuJoCo's model: rays straight down tell what carries an object or a goal, joints and boxes of links tell where
drawers and doors are.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from functools import cache

import mujoco
import numpy as np

from mjhab.layout.layout import Layout
from mjhab.tasks.plan import Subtask, TaskPlan

OBJECTS = {
    "002_master_chef_can": "coffee can|master chef can",
    "003_cracker_box": "cracker box|box of crackers",
    "004_sugar_box": "sugar box|box of sugar",
    "005_tomato_soup_can": "soup can|tomato soup can",
    "007_tuna_fish_can": "tuna can|tuna fish can",
    "008_pudding_box": "pudding box|box of pudding",
    "009_gelatin_box": "gelatin box|box of gelatin",
    "010_potted_meat_can": "meat can|potted meat can",
    "013_apple": "apple",
    "024_bowl": "bowl",
}
"""What a reader takes the objects of the tasks for."""
FURNITURE = {
    "bathtub": "bathtub",
    "beanbag": "beanbag",
    "bed": "bed",
    "bike_01": "bike",
    "bike_02": "bike",
    "bin_01": "bin",
    "bookshelf": "bookshelf",
    "cabinet": "cabinet",
    "chair_01": "chair",
    "chest_of_drawers": "chest of drawers",
    "chestOfDrawers_01": "chest of drawers",
    "clothes_hanger_02": "clothes hanger",
    "fridge": "fridge",
    "indoor_plant_01": "indoor plant",
    "indoor_plant_02": "indoor plant",
    "kitchen_counter": "kitchen counter",
    "kitchen_cupboard_01": "kitchen cupboard",
    "kitchenCupboard_01": "kitchen cupboard",
    "lamp_01": "lamp",
    "picture_01": "picture",
    "picture_02": "picture",
    "sofa": "sofa",
    "table_01": "dining table|table",
    "table_02": "coffee table|table",
    "table_03": "table",
    "tv": "TV",
    "tv_screen": "TV screen",
    "tvstand": "TV stand",
    "wall_cabinet_01": "wall cabinet|cabinet",
    "wall_cabinet_02": "wall cabinet|cabinet",
}
"""What a reader takes the furniture for: "the table" may be the dining table, too."""
CLEAR_M = 0.03
"""A difference of distances below it [m] tells nothing apart."""
PARKED_M = -5.0
REACH_M = 0.4
"""How far [m] below its centre an object's support is at most."""
_ORDER = ("nearest to", "second nearest to", "third nearest to", "fourth nearest to")


def _any(lexicon: dict[str, str]) -> str:
    nouns = {noun for words in lexicon.values() for noun in words.split("|")}
    return "|".join(sorted(nouns, key=len, reverse=True))


_FAR = "|".join((*reversed(_ORDER), "furthest from"))
_LANDMARK = f"(?:{_FAR}) the (?:{_any(OBJECTS)}|{_any(FURNITURE)})"
_PIECE = f"the (?:{_any(FURNITURE)})(?: (?:{_FAR}) the (?:{_any(FURNITURE)}))?"
_PART = (
    r"(?:(?:\w+ )?(?:top|bottom|central|left|right|middle|highest|lowest|leftmost|rightmost) )*"
    r"(?:drawer|door|shelf|part|sink)"
)
_PLACE = f"(?:the {_PART} of )?{_PIECE}"
_OBJECT = f"the (?:(?:left|right)(?:most)? )?(?:{_any(OBJECTS)})(?: {_LANDMARK})?"
_GRAMMAR = {
    "pick": f"(?:pick up|take|grab) (?P<object>{_OBJECT}) from (?P<source>{_PLACE})",
    "place": f"(?:put|place|set) (?P<held>{_OBJECT})(?: down)? (?P<at>on|in) (?P<goal>{_PLACE})",
    "reach": f"(?:go|drive|move) to (?P<object>{_OBJECT}) (?P<lies>on|in) (?P<source>{_PLACE})",
    "carry": f"(?:carry|bring) (?P<held>{_OBJECT}) to (?P<goal>{_PLACE})",
    "approach": f"(?:go|drive|move) to (?P<link>the {_PART} of {_PIECE})",
    "open": f"(?:open (?P<link>the {_PART} of {_PIECE})|pull (?P<link2>the {_PART} of {_PIECE}) open)",
    "close": f"(?:close (?P<link>the {_PART} of {_PIECE})|push (?P<link2>the {_PART} of {_PIECE}) shut)",
    "push": f"(?:push|slide) (?P<object>{_OBJECT}) to another place (?P<at>on|in) (?P<same>{_PLACE})",
    "bring": f"put (?P<object>{_OBJECT}) from (?P<source>{_PLACE}) (?P<at>on|in) (?P<goal>{_PLACE})",
    "shift": f"move (?P<object>{_OBJECT}) (?P<lies>on|in) (?P<same>{_PLACE}) to another place there",
}
"""Forms of a sentence."""
FORMS = {
    "pick": ("pick",),
    "place": ("place",),
    "navigate": ("reach", "carry", "approach"),
    "open": ("open",),
    "close": ("close",),
    "push": ("push",),
}
"""Forms that a kind of subtask may have."""
_READ = {name: re.compile(form) for name, form in _GRAMMAR.items()}


@dataclass(frozen=True, eq=False)
class Support:
    """What carries a point: a piece of furniture, its link ("" for the body), and where the surface is [m, world]."""

    thing: str
    link: str
    point: np.ndarray


@dataclass
class Findings:
    """Count of sentences by outcome, with examples; ``closest``: least difference of distances that was told [m]."""

    counts: Counter[str] = field(default_factory=Counter)
    examples: list[str] = field(default_factory=list)
    closest: float = np.inf


class Wrong(Exception):
    """A sentence is not right: ``args`` are the outcome ("false", "ambiguous", "unread") and why."""


class Reader:
    """Reads the sentences of one episode.

    Args:
        layout: names of things, and templates of furniture.
        model: MuJoCo model of the home.
        qpos: (nq,) state at the start of the subtask, or of the chain.
        plan: the plan.
        goals: objects by name that earlier subtasks of a chain bring to these points [m]; empty for a subtask alone.
    """

    def __init__(
        self, layout: Layout, model: mujoco.MjModel, qpos: np.ndarray, home: str
    ) -> None:
        self.layout = layout
        self.model = model
        self.home = layout.pack.homes_by_name[home]
        self.closest = np.inf
        self._data = mujoco.MjData(model)
        self._data.qpos[:] = qpos
        mujoco.mj_forward(model, self._data)
        self.points = {
            name: self._data.body(name).xpos.copy()
            for name in layout.object_names
            if self._data.body(name).xpos[2] > PARKED_M
        }
        self._clear_away()
        self.supports = {name: self._below(at) for name, at in self.points.items()}
        self._geoms = self._geoms_of_things()
        self._outline = cache(self._outline_of)
        self._left_of = cache(self._left_vector)
        self._pieces = cache(self._pieces_called)
        self.links_called = cache(self._links_called)
        self.places_called = cache(self._places_called)

    # -- truth -----------------------------------------------------------------------------------------------------

    def _clear_away(self) -> None:
        """Take objects and robot out of the way of the rays."""
        gone = {*self.layout.object_names}
        for g in range(self.model.ngeom):
            root = self.model.body(self.model.body_rootid[self.model.geom_bodyid[g]]).name
            link = root in self.layout.link_ids
            if root in gone or not (link or root == "world"):
                self._data.geom_xpos[g, 2] -= 100.0

    def _below(self, point: np.ndarray) -> Support | None:
        """What a ray straight down from a point meets; None for the floor and for nothing."""
        geom = np.zeros(1, np.int32)
        down = np.array([0.0, 0.0, -1.0])
        depth = mujoco.mj_ray(
            self.model, self._data, np.asarray(point, float), down, None, 1, -1, geom
        )
        if not 0.0 <= depth <= REACH_M or geom[0] < 0:
            return None
        name = self.model.geom(geom[0]).name
        parts = name.split("/")
        if len(parts) < 2:
            return None
        link = "/".join(parts[:2]) if len(parts) > 2 else ""
        return Support(parts[0], link, np.asarray(point, float) + depth * down)

    def _geoms_of_things(self) -> dict[str, list[int]]:
        found: dict[str, list[int]] = {}
        for g in range(self.model.ngeom):
            thing, _, rest = self.model.geom(g).name.partition("/")
            if rest and self._data.geom_xpos[g, 2] > PARKED_M:
                found.setdefault(thing, []).append(g)
        return found

    def _template(self, thing: str) -> str:
        slots = {slot.name: slot.template for slot in self.layout.prop_slots}
        return slots.get(thing, thing)

    def _corners(self, geom: int) -> np.ndarray:
        """(8, 3) [m] corners of the bounding box of a geom, world frame."""
        centre, half = self.model.geom_aabb[geom].reshape(2, 3)
        signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, 8).T
        turn = self._data.geom_xmat[geom].reshape(3, 3)
        return self._data.geom_xpos[geom] + (centre + signs * half) @ turn.T

    def _outline_of(self, thing: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centre (2,), axes (2, 2) and half-sizes (2,) [m] of the rectangle around a piece's body."""
        placed = [*self.home.props, *self.home.articulations]
        name = self._template(thing)
        own = [at for at in placed if at.template == name]
        index = {slot.name: slot.index for slot in self.layout.prop_slots}.get(thing, 0)
        yaw = own[index].yaw
        axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        body = [g for g in self._geoms[thing] if self.model.geom_bodyid[g] == 0]
        local = np.concatenate([self._corners(g)[:, :2] for g in body]) @ axes.T
        low = local.min(0)
        high = local.max(0)
        return (low + high) / 2 @ axes, axes, (high - low) / 2

    def _distances(self, points: np.ndarray, thing: str) -> np.ndarray:
        """(2, N) [m]: distances of points (N, 2) to centre and outline of a piece of furniture."""
        centre, axes, half = self._outline(thing)
        local = np.abs((points - centre) @ axes.T) - half
        outside = np.linalg.norm(np.maximum(local, 0.0), axis=1)
        return np.stack([np.linalg.norm(points - centre, axis=1), outside])

    # -- furniture and places --------------------------------------------------------------------------------------

    def _pieces_called(self, text: str) -> list[str]:
        """Pieces of furniture that words fit: "the chair nearest to the fridge"."""
        found = re.fullmatch(
            f"the ({_any(FURNITURE)})(?: ({_FAR}) the ({_any(FURNITURE)}))?", text
        )
        assert found is not None, text
        noun, order, landmark = found.groups()
        pieces = [
            thing
            for thing in self._geoms
            if noun in FURNITURE.get(self._template(thing), "").split("|")
        ]
        if order is None:
            return pieces
        where = np.stack([self._outline(thing)[0] for thing in pieces])
        return self._ranked(pieces, where, order, self._one_piece(landmark))

    def _one_piece(self, noun: str) -> str:
        pieces = self._pieces(f"the {noun}")
        if len(pieces) != 1:
            raise Wrong("ambiguous", f"{len(pieces)} landmarks are 'the {noun}'")
        return pieces[0]

    def _ranked(
        self, names: list[str], where: np.ndarray, order: str, landmark: str
    ) -> list[str]:
        """The thing that is nearest, second nearest, ... to a piece of furniture, by its centre and its outline."""
        return self._by_distance(names, self._distances(where, landmark), order)

    def _by_distance(self, names: list[str], d: np.ndarray, order: str) -> list[str]:
        rank = -1 if order == "furthest from" else _ORDER.index(order)
        chosen: set[str] = set()
        for row in d:
            sequence = np.argsort(row)
            at = range(len(names))[rank]
            mine = row[sequence[at]]
            others = np.delete(row, sequence[at])
            if len(others):
                gap = float(np.abs(others - mine).min())
                self.closest = min(self.closest, gap)
                if gap < CLEAR_M:
                    raise Wrong("ambiguous", f"{order}: {gap:.3f} m apart")
            chosen.add(names[sequence[at]])
        if len(chosen) > 1:
            raise Wrong("ambiguous", f"{order}: centre and outline disagree")
        return list(chosen)

    def _left_vector(self, thing: str) -> np.ndarray:
        """(2,) unit vector to the left of somebody who faces the side to which drawers come out and doors open."""
        outs = []
        for link in self._links(thing):
            body = self.model.body(link)
            joint = self.model.joint(link)
            axis = self._data.body(link).xmat.reshape(3, 3) @ joint.axis
            if joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE:
                outs.append(axis[:2])
            else:
                # The door lies in front of the middle of the furniture.
                centre = self._closed_box(link).mean(0)[:2]
                outs.append(centre - self._outline(thing)[0])
            assert body is not None
        out = np.sum(outs, axis=0)
        out = out / np.linalg.norm(out)
        facing = -out
        return np.array([-facing[1], facing[0]])

    def _links(self, thing: str) -> list[str]:
        return [
            link
            for link in self.layout.link_ids
            if link.startswith(f"{thing}/") and self._data.body(link).xpos[2] > PARKED_M
        ]

    def _closed_box(self, link: str) -> np.ndarray:
        """(2, 3) [m] bounds of a link's geoms with the joint at 0, world frame."""
        closed = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, closed)
        body = self.model.body(link).id
        points = []
        for g in np.flatnonzero(self.model.geom_bodyid == body):
            centre, half = self.model.geom_aabb[g].reshape(2, 3)
            signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, 8).T
            turn = closed.geom_xmat[g].reshape(3, 3)
            points.append(closed.geom_xpos[g] + (centre + signs * half) @ turn.T)
        stacked = np.concatenate(points)
        return np.stack([stacked.min(0), stacked.max(0)])

    def _links_called(self, text: str) -> list[str]:
        """Links that words fit: "the top right drawer of the kitchen counter"."""
        found = re.fullmatch(f"the ({_PART}) of ({_PIECE})", text)
        if found is None:
            raise Wrong("unread", text)
        part, piece = found.groups()
        *where, noun = part.split()
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        result = []
        for thing in self._pieces(piece):
            left = self._left_of(thing) if self._links(thing) else np.zeros(2)
            boxes = {
                link: self._seen(link, left)
                for link in self._links(thing)
                if (self.model.joint(link).type[0] == slide) == (noun == "drawer")
            }
            result += [
                link for link in boxes if all(_is(word, link, boxes) for word in where)
            ]
        return result

    def _seen(self, link: str, left: np.ndarray) -> np.ndarray:
        """(2, 2) [m] extent of a link as seen from the front: to the right, upwards."""
        low, high = self._closed_box(link)
        corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
        right = corners @ -left
        return np.array([[right.min(), low[2]], [right.max(), high[2]]])

    def fits(self, support: Support | None, text: str) -> bool:
        """Whether what carries something is the place that words name."""
        if support is None:
            return False
        found = re.fullmatch(f"(?:the ({_PART}) of )?({_PIECE})", text)
        if found is None:
            raise Wrong("unread", text)
        part, piece = found.groups()
        pieces = self._pieces(piece)
        if len(pieces) != 1:
            raise Wrong("ambiguous", f"{len(pieces)} pieces are {piece!r}")
        if support.thing != pieces[0]:
            return False
        return not part or self._in_part(support, part, text)

    def _in_part(self, support: Support, part: str, text: str) -> bool:
        *where, noun = part.split()
        if noun == "drawer":
            links = self.links_called(text)
            if len(links) != 1:
                raise Wrong("ambiguous", f"{len(links)} links are {text!r}")
            return support.link == links[0]
        if noun == "shelf":
            return _is_level(self._shelf_rank(support), " ".join(where))
        sink = self._surface(support.thing, "sink")
        in_sink = bool(np.abs(support.point - sink).max() < 0.3) and (
            abs(support.point[2] - sink[2]) < 0.05
        )
        if noun == "sink":
            return in_sink
        left = self._left_of(support.thing)
        side = float((support.point[:2] - sink[:2]) @ left)
        on_top = not support.link and not in_sink
        return on_top and (side > 0) == (where == ["left"])

    def _surface(self, thing: str, name: str) -> np.ndarray:
        """(3,) [m] centre of a surface that the pack names, world frame."""
        template = self.layout.pack.articulations[thing]
        pos = next(r.pos for r in template.receptacles if r.name == name)
        return self._moved(thing, pos)

    def _moved(self, thing: str, pos: tuple[float, float, float]) -> np.ndarray:
        at = next(at for at in self.home.articulations if at.template == thing)
        out = np.zeros(3)
        mujoco.mju_rotVecQuat(out, np.array(pos), np.array(at.rotation))
        return out + np.array(at.pos)

    def _shelf_rank(self, support: Support) -> tuple[int, int]:
        """Number of the shelf that carries something, from the top, and of all shelves."""
        template = self.layout.pack.articulations[support.thing]
        heights = sorted(
            (self._moved(support.thing, r.pos)[2] for r in template.receptacles),
            reverse=True,
        )
        gaps = np.abs(np.array(heights) - support.point[2])
        if gaps.min() > 0.05:
            raise Wrong("false", f"on no shelf, {gaps.min():.2f} m off")
        return int(gaps.argmin()), len(heights)

    def _places_called(self, text: str) -> int:
        """How many surfaces of the home the words of a place fit."""
        count = 0
        for thing in self._geoms:
            template = self.layout.pack.props.get(
                self._template(thing)
            ) or self.layout.pack.articulations.get(thing)
            if template is None or not template.receptacles:
                continue
            for r in template.receptacles:
                support = self._support_of(thing, r.link, r.pos)
                shelf = " shelf of the " in text
                count += (shelf == (r.kind == "shelf")) and self.fits(support, text)
        return count

    def _support_of(
        self, thing: str, link: str, pos: tuple[float, float, float]
    ) -> Support:
        if thing in self.layout.pack.articulations:
            template = self.layout.pack.articulations[thing]
            origin = {each.name: each.pos for each in template.links}.get(link, (0, 0, 0))
            local = (origin[0] + pos[0], origin[1] + pos[1], origin[2] + pos[2])
            point = self._moved(thing, local)
            return Support(thing, f"{thing}/{link}" if link else "", point)
        return Support(thing, "", np.array([*self._outline(thing)[0], 0.0]))

    # -- objects ---------------------------------------------------------------------------------------------------

    def candidates(
        self, text: str, place: str, moved: dict[str, np.ndarray]
    ) -> list[str]:
        """Objects that words fit: "the left bowl" in a place.

        Args:
            text: the object.
            place: where it lies.
            moved: objects that lie elsewhere by now, and where [m].
        """
        noun, side, order, landmark = read_object(text)
        where = {**self.points, **moved}
        supports = {
            name: self._below(where[name]) if name in moved else self.supports[name]
            for name in where
        }
        there = [name for name, support in supports.items() if self.fits(support, place)]
        names = [name for name in there if noun in _nouns(name)]
        if len(names) < 2 and not (side or order):
            return names
        xy = np.array([where[name][:2] for name in names]).reshape(-1, 2)
        if side:
            if len(names) < 2 or (len(names) > 2) != side.endswith("most"):
                raise Wrong("false", f"{side} of {len(names)}")
            thing = next(s.thing for s in supports.values() if self.fits(s, place) and s)
            along = xy @ (self._left_of(thing) * (1 if side.startswith("left") else -1))
            first, second = np.argsort(-along)[:2]
            gap = float(along[first] - along[second])
            self.closest = min(self.closest, gap)
            if gap < CLEAR_M:
                raise Wrong("ambiguous", f"{side}: {gap:.3f} m apart")
            return [names[first]]
        if not order:
            return names
        own = [name for name in there if landmark in _nouns(name)]
        if landmark in _any(OBJECTS).split("|"):
            if len(own) != 1:
                raise Wrong("ambiguous", f"{len(own)} landmarks are 'the {landmark}'")
            d = np.linalg.norm(xy - where[own[0]][:2], axis=1)[None]
            return self._by_distance(names, d, order)
        return self._ranked(names, xy, order, self._one_piece(landmark))


def read_object(text: str) -> tuple[str, str, str, str]:
    """Noun, side, order and landmark of the words for an object, "" for what is not said."""
    found = re.fullmatch(
        f"the (?:((?:left|right)(?:most)?) )?({_any(OBJECTS)})"
        f"(?: ({_FAR}) the ({_any(OBJECTS)}|{_any(FURNITURE)}))?",
        text,
    )
    if found is None:
        raise Wrong("unread", text)
    side, noun, order, landmark = found.groups()
    return noun, side or "", order or "", landmark or ""


def _nouns(obj: str) -> list[str]:
    return OBJECTS[obj.partition("_:")[0]].split("|")


def _is(word: str, link: str, boxes: dict[str, np.ndarray]) -> bool:
    """Whether a link is the top one, the left one, ... among links, each (2, 2): right and up, least and greatest."""
    own = boxes[link]
    others = [box for name, box in boxes.items() if name != link]
    column = [box for box in others if _meet(own[:, 0], box[:, 0])]
    above = any(box[:, 1].mean() > own[:, 1].mean() for box in column)
    below = any(box[:, 1].mean() < own[:, 1].mean() for box in column)
    left = any(
        box[:, 0].mean() < own[:, 0].mean()
        for box in others
        if not _meet(own[:, 0], box[:, 0])
    )
    right = any(
        box[:, 0].mean() > own[:, 0].mean()
        for box in others
        if not _meet(own[:, 0], box[:, 0])
    )
    truth: dict[str, Callable[[], bool]] = {
        "top": lambda: not above and below,
        "bottom": lambda: above and not below,
        "left": lambda: not left and right,
        "right": lambda: left and not right,
        "middle": lambda: left and right,
        "central": lambda: left and right and above and below,
    }
    return truth[word]()


def _meet(a: np.ndarray, b: np.ndarray) -> bool:
    common = min(a[1], b[1]) - max(a[0], b[0])
    return bool(common > 0.5 * min(a[1] - a[0], b[1] - b[0]))


def _is_level(rank: tuple[int, int], words: str) -> bool:
    at, count = rank
    ordinals = ("second", "third", "fourth")
    if words in ("top", "bottom"):
        return at == (0 if words == "top" else count - 1)
    if words == "middle":
        return 2 * at == count - 1
    ordinal, end = words.split()
    number = ordinals.index(ordinal) + 1
    return at == (number if end == "highest" else count - 1 - number)


def parse(forms: Collection[str], sentence: str) -> dict[str, str]:
    """Parts of a sentence that has one of some forms.

    Raises:
        Wrong: it has none.
    """
    for form in forms:
        found = _READ[form].fullmatch(sentence)
        if found is not None:
            parts = {name: text for name, text in found.groupdict().items() if text}
            if "link2" in parts:
                parts["link"] = parts.pop("link2")
            return parts
    raise Wrong("unread", sentence)


def check_subtask(
    reader: Reader, subtask: Subtask, sentence: str, moved: dict[str, np.ndarray]
) -> None:
    """Hold the sentence of a subtask against the state.

    Args:
        reader: reads the state.
        subtask: what is asked for.
        sentence: how it is told.
        moved: objects that subtasks before it have brought elsewhere, and where [m].

    Raises:
        Wrong: it is false, fits several things, or cannot be read.
    """
    parts = parse(FORMS[subtask.name], sentence)
    _check_parts(reader, subtask, parts, moved)


def _check_parts(
    reader: Reader, subtask: Subtask, parts: dict[str, str], moved: dict[str, np.ndarray]
) -> None:
    obj = subtask.target.removeprefix("goal of ")
    if "link" in parts:
        links = reader.links_called(parts["link"])
        if subtask.target not in links:
            raise Wrong("false", f"{parts['link']} is {links}")
        if len(links) > 1:
            raise Wrong("ambiguous", f"{parts['link']} is {links}")
    if "held" in parts:
        noun, side, order, _ = read_object(parts["held"])
        if noun not in _nouns(obj) or side or order:
            raise Wrong("false", f"{parts['held']} is {obj}")
    if "object" in parts:
        place = parts.get("source") or parts["same"]
        found = reader.candidates(parts["object"], place, moved)
        if obj not in found:
            raise Wrong("false", f"{parts['object']} from {place} is {found}, not {obj}")
        if len(found) > 1:
            raise Wrong("ambiguous", f"{parts['object']} from {place} is {found}")
        _check_preposition(parts.get("lies", ""), place)
    goal = parts.get("goal") or parts.get("same")
    if goal:
        support = reader._below(np.array(subtask.goal_pos))
        if not reader.fits(support, goal):
            raise Wrong("false", f"the goal is on {support}, not {goal}")
        count = reader.places_called(goal)
        if count != 1:
            raise Wrong("ambiguous", f"{count} places are {goal}")
        _check_preposition(parts.get("at", ""), goal)


def _check_preposition(said: str, place: str) -> None:
    inside = place.startswith("the ") and bool(
        re.match(r"the (?:\w+ )*(?:drawer|sink) of ", place)
    )
    if said and said != ("in" if inside else "on"):
        raise Wrong("false", f"{said} {place}")


def sentences(
    plan: TaskPlan, told: dict, names: Collection[str]
) -> Iterator[tuple[Subtask, str, bool]]:
    """Subtasks of a plan with their sentences and, of a whole task, the parts of its sentence (True)."""
    for subtask, sentence in zip(plan.subtasks, told["instructions"], strict=True):
        yield subtask, sentence, False
    if told["subtask"]:
        return
    name, _, rest = told["instruction"].partition(": ")
    if name not in names:
        raise Wrong("unread", told["instruction"])
    brought = [s for s in plan.subtasks if s.name in ("place", "push")]
    moves = rest.split(", then ")
    if len(moves) != len(brought):
        raise Wrong("unread", told["instruction"])
    yield from (
        (subtask, move, True) for subtask, move in zip(brought, moves, strict=True)
    )


def check_episode(
    reader: Reader, plan: TaskPlan, told: dict, names: Collection[str]
) -> Findings:
    """Check all sentences of an episode.

    Those of subtasks are checked after the subtasks before them, and those of whole tasks at the start.

    Args:
        reader: reads the state at the start.
        plan: the plan.
        told: description of the episode, of `info["episode_spec"]`.
        names: names of the task, as it is said.
    """
    found = Findings()
    if told["subtask"] and told["instruction"] != told["instructions"][0]:
        found.counts["false"] += 1
    moved: dict[str, np.ndarray] = {}
    try:
        each = list(sentences(plan, told, names))
    except Wrong as wrong:
        each = []
        _note(found, wrong, told["instruction"])
    for subtask, sentence, of_task in each:
        states = [{}] if of_task else [dict(moved)]
        _check_states(reader, subtask, sentence, states, found, of_task)
        if not of_task and subtask.name in ("place", "push"):
            moved[subtask.obj] = np.array(subtask.goal_pos)
    found.closest = reader.closest
    return found


def _check_states(
    reader: Reader,
    subtask: Subtask,
    sentence: str,
    states: list[dict[str, np.ndarray]],
    found: Findings,
    of_task: bool,
) -> None:
    try:
        for moved in states:
            now = {name: at for name, at in moved.items() if name != subtask.obj}
            if of_task:
                parts = parse(("bring", "shift", "place"), sentence)
                _check_parts(reader, subtask, parts, now)
            else:
                check_subtask(reader, subtask, sentence, now)
        found.counts["true"] += 1
    except Wrong as wrong:
        _note(found, wrong, sentence)


def _note(found: Findings, wrong: Wrong, sentence: str) -> None:
    outcome, why = wrong.args
    found.counts[outcome] += 1
    found.examples.append(f"{outcome}: {sentence!r}: {why}")
