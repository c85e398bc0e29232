"""Start of Open: the robot faces the object that the link is opened for; in training some drawers start ajar."""

from __future__ import annotations

import numpy as np

from mjhab.episodes.spawns import SpawnGoal
from mjhab.episodes.starts.scene import StartContext, SubtaskStart

AJAR = 0.2
"""Opening of a drawer that starts ajar, as a fraction of the opening that counts as open (mshab/envs/open.py)."""


class OpenStart(SubtaskStart):
    """Start of Open, see the module."""

    def prepare(self, scene: StartContext) -> None:
        state = scene.state
        subtask = scene.subtask
        link = state.link(subtask.link).link
        # Only drawers, as in the original.
        if link.joint != "slide" or scene.rng.uniform() >= state.config.open_start:
            return
        low, high = link.range
        opened = state.open_at(subtask.link) * (high - low)
        scene.qpos[state.link_address(subtask.link)] = low + AJAR * opened
        target = next(t for t in scene.episode.targets if t.obj == subtask.obj)
        if target.start_link == subtask.link:
            # The object lies in the drawer and comes out with it.
            state.carry_along(scene.episode, subtask.obj, subtask.link, scene.qpos)

    def stand(self, scene: StartContext) -> SpawnGoal:
        """Return a spawn in the front area of the link that faces the object's present or future place behind it."""
        subtask = scene.subtask
        target = next(t for t in scene.episode.targets if t.obj == subtask.obj)
        inside = (
            target.start_pos if target.start_link == subtask.link else target.goal_pos
        )
        return SpawnGoal(np.array(inside[:2]), self.approach(scene).area)


START = OpenStart()
