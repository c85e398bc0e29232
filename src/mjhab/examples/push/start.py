"""How Push begins: the robot stands within reach of the object and its goal, facing the middle between them."""

from __future__ import annotations

import numpy as np

from mjhab.episodes.spawns import SpawnGoal
from mjhab.episodes.starts import StartContext, SubtaskStart

REACH_M = 0.85
"""The base stands at most so far from the middle of the way that the object is pushed."""


class PushStart(SubtaskStart):
    """See the module. The home needs no preparation."""

    def stand(self, scene: StartContext) -> SpawnGoal:
        start = scene.state.object_address(scene.subtask.obj)
        goal = np.array(scene.subtask.goal_pos[:2])
        return SpawnGoal((scene.qpos[start : start + 2] + goal) / 2, reach=REACH_M)
