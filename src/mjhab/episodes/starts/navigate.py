"""How Navigate begins: what the plan has opened stands open, what it carries is in the hand, the robot is elsewhere."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjhab.episodes.spawns import TELEPORT_DISTANCE, TELEPORT_YAW_NOISE, Held, SpawnGoal
from mjhab.episodes.starts.scene import Scene, Situation, SubtaskStart
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import spec_of

TURN_SPARE = 0.02
"""By how much [rad] a teleport must face its goal better than success asks for: its noise is clipped at that very angle
(`spawns.YAW_NOISE`), and one teleport in twenty would end there, fail by a rounding error and stay so to the end."""

DOORSTEP = (-1.0, 0.0)
DOORSTEP_REACH = 0.5
DOORSTEP_YAW = (-np.pi / 2, np.pi / 2)
"""Where the first Navigate of PrepareGroceries begins, how near to it, and heading [m, rad]
(mshab/utils/gen/gen_spawn_positions.py, in ReplicaCAD's apartment)."""


class NavigateStart(SubtaskStart):
    """See the module."""

    def prepare(self, scene: Scene) -> Held | None:
        state = scene.state
        subtask = scene.subtask
        link, placed = scene.open_before()
        if link:
            state.leave_open(scene.rng, scene.episode, link, scene.qpos, placed=placed)
        if not subtask.must_hold:
            return None
        if subtask.link:
            state.ensure_open(scene.rng, scene.episode.home, subtask.link, scene.qpos)
        return state.hold(scene.rng, subtask.obj, scene.qpos)

    def stand(self, scene: Scene) -> SpawnGoal:
        """Anywhere, or where the plan was before; then its first one begins at the original's doorstep.

        In a home that has no floor there it begins where there is most room.
        """
        if not TASKS[scene.episode.task].departs_from_last_goal:
            return SpawnGoal(None)
        before = [
            s.goal_pos for s in scene.plan.subtasks[: scene.position] if _leads_somewhere(s.kind)
        ]
        if before:
            return SpawnGoal(np.array(before[-1][:2]))
        sampler = scene.state.sampler
        home = scene.episode.home
        at = SpawnGoal(None, near=np.array(DOORSTEP), reach=DOORSTEP_REACH, yaw=DOORSTEP_YAW)
        if not at.allows(sampler.walkable(home)).any():
            at = dataclasses.replace(at, near=sampler.roomiest(home))
        return at

    def approach(self, situation: Situation) -> SpawnGoal:
        """Where it ends, when the environment does it."""
        limits = situation.state.task_config
        goal = SpawnGoal(
            np.array(situation.subtask.goal_pos[:2]),
            situation.area,
            turn=limits.nav_bearing - TURN_SPARE,
        )
        if not situation.state.published:
            return goal
        # The front area binds only where the Navigate is judged by it. A teleport must end where that is achieved.
        judged = None if situation.subtask.must_hold else goal.area
        return dataclasses.replace(
            goal,
            area=judged,
            reach=TELEPORT_DISTANCE,
            yaw_noise=TELEPORT_YAW_NOISE,
            slack=limits.nav_distance - TELEPORT_DISTANCE if judged is None else 0.0,
            published=True,
        )


def _leads_somewhere(kind: int) -> bool:
    spec = spec_of(kind)
    return spec.navigates or spec.brings_to_goal


START = NavigateStart()
