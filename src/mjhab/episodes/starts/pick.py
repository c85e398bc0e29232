"""Start of Pick: the link that the object is behind is open, the robot faces the object."""

from __future__ import annotations

import numpy as np

from mjhab.episodes.spawns import SpawnGoal
from mjhab.episodes.starts.scene import StartContext, SubtaskContext, SubtaskStart
from mjhab.tasks.household.registry import TASKS


class PickStart(SubtaskStart):
    """Start of Pick, see the module."""

    def prepare(self, scene: StartContext) -> None:
        subtask = scene.subtask
        if subtask.link:
            # In tasks whose plans open links, the opening of the link is drawn.
            anew = bool(TASKS[scene.episode.task].opened_links)
            home = scene.episode.home
            scene.state.ensure_open(scene.rng, home, subtask.link, scene.qpos, anew=anew)
            scene.state.carry_along(scene.episode, subtask.obj, subtask.link, scene.qpos)

    def stand(self, scene: StartContext) -> SpawnGoal:
        if not scene.state.published:
            return self.approach(scene)
        start = scene.state.object_address(scene.subtask.obj)
        # Where the object now is: its drawer may have carried it along.
        return SpawnGoal(scene.qpos[start : start + 2])

    def approach(self, situation: SubtaskContext) -> SpawnGoal:
        return SpawnGoal(np.array(situation.last_way[:2]), situation.area)


START = PickStart()
