"""Start of Close: the link is open, its object is at its goal, the robot faces the furniture."""

from __future__ import annotations

import numpy as np

from mjhab.episodes.spawns import SpawnGoal
from mjhab.episodes.starts.fronts import link_front
from mjhab.episodes.starts.scene import StartContext, SubtaskStart


class CloseStart(SubtaskStart):
    """Start of Close, see the module."""

    def prepare(self, scene: StartContext) -> None:
        scene.state.leave_open(
            scene.rng, scene.episode, scene.subtask.link, scene.qpos, placed=True
        )

    def stand(self, scene: StartContext) -> SpawnGoal:
        """Return a spawn in the front area that faces its origin, as in mshab/utils/gen/gen_spawn_positions.py."""
        # The object is at its goal by then, which may be far from the link.
        front = link_front(scene.state.layout, scene.home, scene.subtask.link)
        return SpawnGoal(np.array(front.root), self.approach(scene).area)


START = CloseStart()
