"""Language instructions of an episode, from the receptacles that its objects start on and go to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial

from mjhab.core.names import kind_of
from mjhab.core.seeding import stream
from mjhab.episodes.episode import Episode
from mjhab.episodes.zones import receptacle_below
from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import PlacedReceptacle, placed_receptacles
from mjhab.scenes.objects import object_words
from mjhab.scenes.spec import Vec3
from mjhab.tasks.instructions import (
    Instructions,
    Request,
    Spot,
    instructions,
    seeded_draw,
)
from mjhab.tasks.plan import GOAL_OF, Subtask, TaskPlan


class Narrator:
    """Makes the language instructions of episodes of a layout.

    Args:
        layout: gives receptacles and object names.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._homes = layout.pack.homes_by_name
        self._receptacles = cache(self._receptacles_of)

    def instructions(self, episode: Episode, plan: TaskPlan, alone: bool) -> Instructions:
        """Return the instructions of an episode; the same arguments give the same words.

        Args:
            episode: its seed and index draw the wordings.
            plan: subtasks to describe.
            alone: the plan is a single subtask instead of a chain.
        """
        spots = cache(partial(_spot, self._receptacles(episode.home)))
        requests = [self._request(episode, subtask, spots) for subtask in plan.subtasks]
        draw = seeded_draw(stream(episode.seed, "instruction", episode.index))
        return instructions(episode.task, requests, alone, draw)

    def _request(
        self, episode: Episode, subtask: Subtask, spots: Callable[[Vec3], Spot]
    ) -> Request:
        source = Spot()
        if subtask.obj:
            slot = self._layout.object_names.index(subtask.obj)
            x, y, z = episode.object_pose[slot, :3].tolist()
            source = spots((x, y, z))
        goal = spots(subtask.goal_pos)
        names = object_words(kind_of(subtask.target.removeprefix(GOAL_OF)))
        return Request(subtask.name, subtask.target, source, goal, names)

    def _receptacles_of(self, home: str) -> tuple[PlacedReceptacle, ...]:
        return placed_receptacles(self._layout, self._homes[home])


def _spot(places: Sequence[PlacedReceptacle], point: Vec3) -> Spot:
    found = receptacle_below(point, places)
    return Spot() if found is None else Spot(found.template, found.kind != "open")
