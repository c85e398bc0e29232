"""Start of Place: the object is in the gripper, the link of its goal is open, the robot faces the goal."""

from __future__ import annotations

import numpy as np

from mjhab.episodes.spawns import Held, SpawnGoal
from mjhab.episodes.starts.scene import StartContext, SubtaskStart


class PlaceStart(SubtaskStart):
    """Start of Place, see the module."""

    def prepare(self, scene: StartContext) -> Held:
        subtask = scene.subtask
        if subtask.link:
            scene.state.ensure_open(
                scene.rng, scene.episode.home, subtask.link, scene.qpos
            )
        return scene.state.hold(scene.rng, subtask.obj, scene.qpos)

    def stand(self, scene: StartContext) -> SpawnGoal:
        if scene.state.published:
            return SpawnGoal(np.array(scene.subtask.goal_pos[:2]))
        return self.approach(scene)


START = PlaceStart()
