"""Language instructions of an episode: true of its start, and enough to find what they are about."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from mjhab.core.names import kind_of
from mjhab.core.seeding import stream
from mjhab.episodes.episode import Episode
from mjhab.episodes.narration.apart import Landmark, Mark, mark
from mjhab.episodes.narration.home_words import HomeWords
from mjhab.episodes.narration.places import TemplateWords
from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import PlacedReceptacle
from mjhab.scenes.objects import object_words
from mjhab.scenes.spec import Vec3
from mjhab.tasks.instructions import (
    InstructionRequest,
    Instructions,
    Spot,
    instructions,
    names_of,
    seeded_draw,
    subtask_wordings,
    with_article,
)
from mjhab.tasks.plan import GOAL_OF, Subtask, Target, TaskPlan
from mjhab.tasks.subtasks.registry import spec_of

_DEEP_M = -5.0
"""Objects below this height [m] are parked: the episode does not use them."""


class InstructionGenerator:
    """Makes the language instructions of episodes of a layout.

    What is said of a subtask is true, and fits one thing only, when it starts, after the subtasks before it. What is
    said of a whole task is so at the start of the episode and, where there are such words, also part by part after the
    parts before. No object that the plan moves is a landmark.

    Args:
        layout: gives furniture, receptacles and object names.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._homes = layout.pack.homes_by_name
        # Words of a home take long to find, and all of its episodes share them.
        self._words = cache(self._words_of)

    def instructions(self, episode: Episode, plan: TaskPlan, alone: bool) -> Instructions:
        """Return the instructions of an episode; the same arguments give the same words.

        Args:
            episode: its seed and index draw the wordings.
            plan: subtasks to describe.
            alone: the plan is a single subtask instead of a chain.
        """
        words = self._words(episode.home)
        tale = _Tale(self._layout, episode, plan, words, self._alike)
        positions = range(len(plan.subtasks))
        requests = [tale.request(k) for k in positions]
        # A stream of its own, so that words do not change where objects and robot are.
        draw = seeded_draw(stream(episode.seed, "instruction", episode.index))
        # An episode of one subtask has no sentence for the whole task.
        whole = [] if alone else [tale.request(k, anytime=True) for k in positions]
        return instructions(episode.task, requests, whole, draw)

    def wordings(self, episode: Episode, plan: TaskPlan) -> tuple[tuple[str, ...], ...]:
        """All sentences with which `instructions` may ask for each subtask of a plan."""
        tale = _Tale(self._layout, episode, plan, self._words(episode.home), self._alike)
        positions = range(len(plan.subtasks))
        return tuple(subtask_wordings(tale.request(k)) for k in positions)

    def _words_of(self, home: str) -> HomeWords:
        return HomeWords(self._layout, self._homes[home], self._templates)

    @cached_property
    def _alike(self) -> Mapping[str, frozenset[str]]:
        """By object, the others that its names fit; once for all episodes, since comparing names takes long."""
        objects = self._layout.object_names
        return {
            obj: frozenset(
                other for other in objects if other != obj and _fits(_names(obj), other)
            )
            for obj in objects
        }

    @cached_property
    def _templates(self) -> dict[str, TemplateWords]:
        pack = self._layout.pack
        templates = (*pack.props.values(), *pack.articulations.values())
        return {each.name: TemplateWords(each, pack.meshes) for each in templates}


@dataclass(frozen=True, eq=False)
class _Tale:
    """One episode that is described: its objects and plan, and the words of its home.

    alike: by object, the others that its names fit.
    """

    layout: Layout
    episode: Episode
    plan: TaskPlan
    words: HomeWords
    alike: Mapping[str, frozenset[str]]

    def request(self, position: int, anytime: bool = False) -> InstructionRequest:
        """Content of the sentence of the subtask at a position of the plan.

        ``anytime``: it fits at the start of the episode, too, not only when the subtask starts.
        """
        subtask = self.plan.subtasks[position]
        target = subtask.target
        goal = self._spot(self._goal_places[position])
        obj = target.removeprefix(GOAL_OF)
        # Open and Close are about a link, and their target names it.
        if obj not in self.layout.object_names:
            known = obj in self.layout.link_ids
            names = (self.words.link(obj),) if known else ()
            return InstructionRequest(subtask.name, target, Spot(), goal, names)
        place = self.place(obj) if obj in self.points else None
        found = self._mark(position, obj, anytime) if obj in self.points else Mark()
        return InstructionRequest(
            subtask.name,
            target,
            self._spot(place),
            goal,
            object_words(kind_of(obj)),
            found.before,
            found.after,
        )

    def _spot(self, place: PlacedReceptacle | None) -> Spot:
        return self.words.spot(place)

    def _goal_place(self, subtask: Subtask) -> PlacedReceptacle | None:
        spec = spec_of(subtask.kind)
        if spec.jointed or (spec.navigates and not subtask.must_hold):
            return None
        target = self._targets.get(subtask.obj)
        link = target.goal_link if target is not None else ""
        return self.words.place(subtask.goal_pos, link)

    @cached_property
    def _goal_places(self) -> tuple[PlacedReceptacle | None, ...]:
        """Where the goal of each subtask of the plan is."""
        return tuple(map(self._goal_place, self.plan.subtasks))

    # -- objects ---------------------------------------------------------------------------------------------------

    @cached_property
    def _targets(self) -> dict[str, Target]:
        return {target.obj: target for target in self.episode.targets}

    @cached_property
    def points(self) -> dict[str, Vec3]:
        """Positions [m, world] of the objects at the start of the episode, of those that it uses."""
        poses = self.episode.object_pose[:, :3].tolist()
        named = zip(self.layout.object_names, poses, strict=True)
        return {name: (x, y, z) for name, (x, y, z) in named if z > _DEEP_M}

    @cached_property
    def place(self) -> Callable[[str], PlacedReceptacle | None]:
        """The receptacle of an object of `points`; found once, and only of those of which something is told."""
        return cache(self._place)

    def _place(self, obj: str) -> PlacedReceptacle | None:
        target = self._targets.get(obj)
        return self.words.place(self.points[obj], target.start_link if target else "")

    def _mark(self, position: int, obj: str, anytime: bool) -> Mark:
        """What tells an object from others that its name and its place fit."""
        place = self.place(obj)
        # Compared in words: two places that are called the same are the same to a reader.
        spot = self._spot(place)
        others: list[tuple[float, float]] = []
        at_start = []
        at_times = False
        for name in self._rivals(obj):
            found = self._whereabouts(position, name, anytime)
            here = [
                point[:2]
                for point, where in found
                if place is None or where is None or self._spot(where) == spot
            ]
            others += here
            # One that moves within the place is one thing, not two.
            at_times |= bool(here) and len(found) > 1
            at_start += here[: bool(here) and here[0] == self.points[name][:2]]
        if not others:
            return Mark()
        return self._apart(obj, tuple(others), tuple(at_start) if at_times else None)

    def _find_apart(
        self,
        obj: str,
        others: tuple[tuple[float, float], ...],
        at_start: tuple[tuple[float, float], ...] | None,
    ) -> Mark:
        """Words that fit an object and none of the others.

        Args:
            obj: the object.
            others: x, y [m] of the others.
            at_start: of those that are there at the start of the episode; None if all are there all the time.
        """
        place = self.place(obj)
        own = self.points[obj][:2]
        left = self.words.left(place)
        without = {obj, *self._rivals(obj)}
        spot = self._spot(place)
        near = self._landmarks_on(spot, without) if place is not None else []
        far = self.words.landmarks_besides(place)
        moves = at_start is not None
        found = mark(np.array([own, *others]), left, near, far, superlatives=moves)
        if found is None and at_start:
            # Nothing fits at all times: then what fits at the start, when the sentence is said.
            found = mark(np.array([own, *at_start]), left, near, far)
        return found or Mark()

    @cached_property
    def _apart(self) -> Callable[..., Mark]:
        """`_find_apart`, once for each arrangement: most sentences of a whole task are about the same one."""
        return cache(self._find_apart)

    @cached_property
    def _rivals(self) -> Callable[[str], list[str]]:
        """Objects of the episode that the names of an object fit; found once for each object."""
        return cache(
            lambda obj: [name for name in self.points if name in self.alike[obj]]
        )

    @cached_property
    def _carried(self) -> dict[str, list[tuple[int, Vec3, PlacedReceptacle | None]]]:
        """By object, the subtasks that bring it to their goal: position in the plan, where, and on what."""
        found: dict[str, list[tuple[int, Vec3, PlacedReceptacle | None]]] = {}
        for position, subtask in enumerate(self.plan.subtasks):
            if spec_of(subtask.kind).brings_to_goal:
                row = (position, subtask.goal_pos, self._goal_places[position])
                found.setdefault(subtask.obj, []).append(row)
        return found

    def _whereabouts(
        self, position: int, obj: str, anytime: bool
    ) -> list[tuple[Vec3, PlacedReceptacle | None]]:
        """Where an object is when the subtask at ``position`` starts; ``anytime``: also at the start of the episode."""
        found = [(self.points[obj], self.place(obj))]
        found += [
            (point, place)
            for when, point, place in self._carried.get(obj, ())
            if when < position
        ]
        return found if anytime else found[-1:]

    def _landmarks_on(self, spot: Spot, without: Collection[str]) -> list[Landmark]:
        """Objects in a place of which there is one of their name there, and which the plan does not move."""
        moved = {subtask.obj for subtask in self.plan.subtasks if subtask.obj}
        here = [name for name in self.points if self._spot(self.place(name)) == spot]
        # What the plan brings here must not be taken for a landmark.
        here += [name for name in moved if name in self.points and name not in here]
        return [
            Landmark(with_article(_names(name)[0]), np.array(self.points[name][:2]))
            for name in here
            if name not in moved
            and name not in without
            and self.alike[name].isdisjoint(here)
        ]


def _names(obj: str) -> tuple[str, ...]:
    """All names of an object's type."""
    kind = kind_of(obj)
    # Objects of other packs have no words of their own: their names serve.
    return object_words(kind) or names_of(kind)


def _fits(names: Collection[str], obj: str) -> bool:
    """Whether one of some names can be said of an object: "mug" also of a "red mug"."""
    return any(
        own == name or own.endswith(f" {name}") for own in _names(obj) for name in names
    )
