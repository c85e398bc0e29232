"""Start of Navigate: links opened earlier in the plan are open, a carried object is in the gripper."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjhab.episodes.spawns import TELEPORT_DISTANCE, TELEPORT_YAW_NOISE, Held, SpawnGoal
from mjhab.episodes.starts.scene import StartContext, SubtaskContext, SubtaskStart
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import spec_of

TURN_SPARE = 0.02
"""Margin [rad] of a teleport's heading to the largest angle of a successful Navigate. The yaw noise is clipped at that
angle (`spawns.YAW_NOISE`): without a margin, rounding would make one teleport in twenty fail."""

DOORSTEP = (-1.0, 0.0)
"""Position x, y [m] near which the first Navigate of PrepareGroceries starts in ReplicaCAD's apartment
(mshab/utils/gen/gen_spawn_positions.py)."""
DOORSTEP_REACH = 0.5
"""Largest distance [m] from it."""
DOORSTEP_YAW = (-np.pi / 2, np.pi / 2)
"""Range of the heading [rad]."""


class NavigateStart(SubtaskStart):
    """Start of Navigate, see the module."""

    def prepare(self, scene: StartContext) -> Held | None:
        state = scene.state
        subtask = scene.subtask
        link, placed = scene.open_before()
        if link:
            state.leave_open(scene.rng, scene.episode, link, scene.qpos, placed=placed)
        if not subtask.must_hold:
            return None
        # The goal of what is carried is behind this link, opened earlier in the plan.
        if subtask.link:
            state.ensure_open(scene.rng, scene.episode.home, subtask.link, scene.qpos)
        return state.hold(scene.rng, subtask.obj, scene.qpos)

    def stand(self, scene: StartContext) -> SpawnGoal:
        """Return constraints of the spawn: anywhere, unless the task departs from the last goal.

        Then the robot starts at the goal of the subtask before, and the first Navigate near DOORSTEP, or, in a home
        without floor there, near the place with the largest clearance.
        """
        if not TASKS[scene.episode.task].departs_from_last_goal:
            return SpawnGoal(None)
        # The nearest subtask before that leads somewhere: a Pick or an Open leaves the robot where it is.
        before = [
            s.goal_pos
            for s in scene.plan.subtasks[: scene.position]
            if _leads_somewhere(s.kind)
        ]
        if before:
            return SpawnGoal(np.array(before[-1][:2]))
        sampler = scene.state.sampler
        home = scene.episode.home
        at = SpawnGoal(
            None, near=np.array(DOORSTEP), reach=DOORSTEP_REACH, yaw=DOORSTEP_YAW
        )
        if not at.allows(sampler.walkable(home)).any():
            # Other homes have no doorstep at these coordinates.
            at = dataclasses.replace(at, near=sampler.roomiest(home))
        return at

    def approach(self, situation: SubtaskContext) -> SpawnGoal:
        """Return constraints of the pose in which a Navigate ends that the environment does by teleport."""
        limits = situation.state.task_config
        goal = SpawnGoal(
            np.array(situation.subtask.goal_pos[:2]),
            situation.area,
            turn=limits.nav_bearing - TURN_SPARE,
        )
        if not situation.state.published:
            return goal
        # With an object in the gripper, success of a Navigate does not depend on the front area of the link.
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
