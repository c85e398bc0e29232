"""Where the objects of an episode stand and its goals are: points drawn on receptacles, clear of each other."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from mjhab.layout.layout import Layout, yaw_quat
from mjhab.layout.receptacles import PlacedReceptacle, link_to_open, with_role
from mjhab.layout.standing import Outlines, clear_of
from mjhab.scenes.roles import FRIDGE_SHELF, OPEN_SURFACE
from mjhab.scenes.spec import Home, Roles
from mjhab.tasks.household.spec import TargetRule, TaskSpec
from mjhab.tasks.plan import Target

GAP = 0.03
"""Least gap [m] between the bounding circles of clutter and its neighbours; a finger is 14 mm thick."""
TARGET_GAP = 0.06
"""The same for targets and goals."""
SHELF_GAP = 0.02
"""The same for targets and goals on the fridge shelf."""
THING_SHARE = 0.5
"""Share of these gaps that is kept to what stands in the home: outlines are exact, bounding circles are not."""
_TRIES = 60
"""Points tried for an object in one draw."""
_GOAL_TRIES = 100
"""Points tried for a goal."""
_CROWDED_TRIES = 400
"""The same in a home that has things of its own on its receptacles."""


@dataclass
class Draw:
    """A draw of object poses in one home.

    ``placed``: (centre (3,), radius) [m] of the bounding circle by slot; goals have negative keys. ``pose``: (N, 7).
    ``standing``: what the home itself has on its receptacles, see `layout.standing`.
    """

    home: Home
    roles: Roles
    receptacles: tuple[PlacedReceptacle, ...]
    placed: dict[int, tuple[np.ndarray, float]]
    pose: np.ndarray
    standing: dict[str, Outlines]
    _found: dict[tuple[str, ...], list[PlacedReceptacle]] = field(
        default_factory=dict, init=False, repr=False
    )

    def places(self, *names: str) -> list[PlacedReceptacle]:
        """Return the receptacles of the home that have one of the roles ``names``."""
        # Asked for at every place that is tried.
        if names not in self._found:
            self._found[names] = with_role(self.receptacles, self.roles, *names)
        return self._found[names]

    def on_shelf(self, place: PlacedReceptacle) -> bool:
        """Return whether a receptacle is the fridge shelf."""
        return any(place is shelf for shelf in self.places(FRIDGE_SHELF))

    def target_gap(self, place: PlacedReceptacle) -> float:
        """Return the least gap [m] between the bounding circles of a target and its neighbours on a receptacle."""
        return SHELF_GAP if self.on_shelf(place) else TARGET_GAP


class Placer:
    """Place the objects of one task on a layout.

    Args:
        layout: has the object slots.
        spec: the rules of the task.
        target: object type that must be among the targets; "" for any.
    """

    def __init__(self, layout: Layout, spec: TaskSpec, target: str) -> None:
        self.layout = layout
        self.spec = spec
        self.target = target

    def place_targets(
        self, rng: np.random.Generator, draw: Draw
    ) -> tuple[Target, ...] | None:
        """Place the targets of the task and choose their goals; None if one finds no room."""
        wanted = [
            (slot, rule, draw.places(*rule.start), draw.places(*rule.goal))
            for rule, slot in zip(self.spec.targets, self._slots(rng), strict=True)
        ]
        return self._targets(rng, draw, wanted)

    def place_clutter(
        self, rng: np.random.Generator, draw: Draw, targets: tuple[Target, ...]
    ) -> bool:
        """Place the objects that are no targets; returns whether all found room."""
        slots = {self.layout.object_names.index(target.obj) for target in targets}
        in_shelf = 0
        for slot in range(self.layout.num_objects):
            if slot in slots:
                continue
            shelf = (FRIDGE_SHELF,) if in_shelf < self.spec.shelf_clutter else ()
            put = self._put(rng, draw, slot, draw.places(OPEN_SURFACE, *shelf), GAP)
            if put is None:
                return False
            in_shelf += draw.on_shelf(put)
        return True

    def _slots(self, rng: np.random.Generator) -> list[int]:
        """Return the slot of each target: that of the rule's object, or a random one, see `_drawn`."""
        rules = self.spec.targets
        named = {rule.object for rule in rules if rule.object}
        # Clutter comes first in a roster, so that of several of a type the last one is the task's own.
        last = {kind: slot for slot, kind in enumerate(self.layout.roster)}
        free = [slot for slot, kind in enumerate(self.layout.roster) if kind not in named]
        count = sum(not rule.object for rule in rules)
        # Without a need for it nothing is drawn, so that the stream of other tasks stays as it is.
        drawn = self._drawn(rng, free, count) if count else []
        return [last[rule.object] if rule.object else drawn.pop(0) for rule in rules]

    def _drawn(self, rng: np.random.Generator, free: list[int], count: int) -> list[int]:
        """Draw ``count`` different slots of ``free``; one is of object type ``target`` if that is given and free."""
        slots = [free[int(i)] for i in rng.choice(len(free), count, replace=False)]
        wanted = [slot for slot in free if self.layout.roster[slot] == self.target]
        if wanted and not any(self.layout.roster[s] == self.target for s in slots):
            slots[int(rng.integers(count))] = int(rng.choice(wanted))
        return slots

    def _targets(
        self,
        rng: np.random.Generator,
        draw: Draw,
        wanted: list[
            tuple[int, TargetRule, list[PlacedReceptacle], list[PlacedReceptacle]]
        ],
    ) -> tuple[Target, ...] | None:
        # All starts before the first goal: a goal must be clear of every object.
        starts: list[PlacedReceptacle] = []
        for slot, _, places, _ in wanted:
            put = self._put(rng, draw, slot, places, draw.target_gap(places[0]))
            if put is None:
                return None
            starts.append(put)
        goals: list[tuple[np.ndarray, float]] = []
        targets = []
        for (slot, rule, _, places), start in zip(wanted, starts, strict=True):
            goal = self._goal(rng, draw, slot, places, rule.distance_m)
            if goal is None:
                return None
            where, pos = goal
            goals.append((pos, self.radius(slot)))
            # Clutter keeps the same distance from goals as from objects.
            draw.placed[-len(goals)] = goals[-1]
            targets.append(self._target(draw, slot, rule, (start, where), pos))
        return tuple(targets)

    def _target(
        self,
        draw: Draw,
        slot: int,
        rule: TargetRule,
        places: tuple[PlacedReceptacle, PlacedReceptacle],
        goal: np.ndarray,
    ) -> Target:
        """Make the target that starts on ``places[0]``, and whose ``goal`` (3,) [m] is on ``places[1]``."""
        start_link, goal_link = (link_to_open(place, draw.roles) for place in places)
        link = goal_link if rule.opens == "goal" else start_link
        return Target(
            obj=self.layout.object_names[slot],
            goal_pos=tuple(goal.tolist()),
            start_pos=tuple(draw.placed[slot][0].tolist()),
            start_link=start_link,
            goal_link=goal_link,
            handle_pos=self.layout.closed_handle(draw.home, link)
            if link
            else (0.0, 0.0, 0.0),
        )

    def radius(self, slot: int) -> float:
        """Return the radius [m] of the bounding circle of an object, seen from above."""
        return float(np.hypot(*self.layout.objects[slot].half[:2]))

    def _sample(
        self,
        rng: np.random.Generator,
        draw: Draw,
        place: PlacedReceptacle,
        radius: float,
        half_z: float,
    ) -> np.ndarray | None:
        if 2 * half_z + 0.02 > place.height:
            return None
        ratio = self.spec.shelf_region if draw.on_shelf(place) else 1.0
        # The centre of an object that barely fits is in the middle.
        room = ratio * np.maximum(np.array(place.half) - radius - 0.01, 0.0)
        # The bounding circle is larger than the object: a place somewhat smaller may still do.
        if min(place.half) < radius * 0.75:
            return None
        u, v = rng.uniform(-room, room)
        return place.point(u, v) + np.array([0.0, 0.0, half_z])

    def _put(
        self,
        rng: np.random.Generator,
        draw: Draw,
        slot: int,
        places: list[PlacedReceptacle],
        gap: float,
    ) -> PlacedReceptacle | None:
        radius = self.radius(slot)
        half_z = self.layout.objects[slot].half[2]
        # By area, so that a draw is uniform over all surfaces together.
        weights = np.array([4 * r.half[0] * r.half[1] for r in places])
        for _ in range(_CROWDED_TRIES if draw.standing else _TRIES):
            place = places[int(rng.choice(len(places), p=weights / weights.sum()))]
            pos = self._sample(rng, draw, place, radius, half_z)
            if pos is None or not self._is_free(draw, place, pos, (radius, gap)):
                continue
            draw.placed[slot] = (pos, radius)
            draw.pose[slot, :3] = pos + np.array([0.0, 0.0, 0.001])
            draw.pose[slot, 3:] = yaw_quat(float(rng.uniform(-np.pi, np.pi)))
            return place
        return None

    def _goal(
        self,
        rng: np.random.Generator,
        draw: Draw,
        slot: int,
        places: list[PlacedReceptacle],
        distance_m: tuple[float, float],
    ) -> tuple[PlacedReceptacle, np.ndarray] | None:
        radius = self.radius(slot)
        half_z = self.layout.objects[slot].half[2]
        weights = np.array([4 * r.half[0] * r.half[1] for r in places])
        start = draw.placed[slot][0]
        for _ in range(_CROWDED_TRIES if draw.standing else _GOAL_TRIES):
            place = places[int(rng.choice(len(places), p=weights / weights.sum()))]
            pos = self._sample(rng, draw, place, radius, half_z)
            if (
                pos is None
                or not distance_m[0]
                <= np.linalg.norm(pos - start, axis=-1)
                <= distance_m[1]
            ):
                continue
            if self._is_free(draw, place, pos, (radius, draw.target_gap(place))):
                return place, pos
        return None

    @staticmethod
    def _is_free(
        draw: Draw, place: PlacedReceptacle, pos: np.ndarray, size: tuple[float, float]
    ) -> bool:
        """Whether a circle about ``pos`` of ``size`` (radius, gap) [m] is clear of objects and of what stands there."""
        radius, gap = size
        if not clear_of(draw.standing.get(place.id, ()), pos, radius + THING_SHARE * gap):
            return False
        x, y, z = pos.tolist()
        # Plain numbers: dozens of objects are asked about at every place that is tried.
        for other, r in draw.placed.values():
            ox, oy, oz = other.tolist()
            # More than a shelf apart in height they cannot meet.
            if abs(oz - z) <= 0.35 and math.hypot(ox - x, oy - y) <= r + radius + gap:
                return False
        return True
