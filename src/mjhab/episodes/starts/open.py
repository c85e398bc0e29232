"""How Open begins: the robot faces the object that the link is opened for; in training, now and then, ajar."""

from __future__ import annotations

import numpy as np

from mjhab.episodes.spawns import SpawnGoal
from mjhab.episodes.starts.scene import Scene, SubtaskStart

AJAR = 0.2
"""Part of the way to open at which a drawer starts that was left ajar (mshab/envs/open.py)."""


class OpenStart(SubtaskStart):
    """See the module."""

    def prepare(self, scene: Scene) -> None:
        state = scene.state
        subtask = scene.subtask
        link = state.link(subtask.link).link
        if link.joint != "slide" or scene.rng.uniform() >= state.config.open_start:
            return
        low, high = link.range
        opened = state.open_at(subtask.link) * (high - low)
        scene.qpos[state.link_address(subtask.link)] = low + AJAR * opened
        target = next(t for t in scene.episode.targets if t.obj == subtask.obj)
        if target.start_link == subtask.link:
            state.carry_along(scene.episode, subtask.obj, subtask.link, scene.qpos)

    def stand(self, scene: Scene) -> SpawnGoal:
        """As in mshab/utils/gen/gen_spawn_positions.py, facing where the object is inside, or will be."""
        subtask = scene.subtask
        target = next(t for t in scene.episode.targets if t.obj == subtask.obj)
        inside = target.start_pos if target.start_link == subtask.link else target.goal_pos
        return SpawnGoal(np.array(inside[:2]), self.approach(scene).area)


START = OpenStart()
