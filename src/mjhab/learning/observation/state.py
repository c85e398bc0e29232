"""The state as a student was trained to see it, whatever the conventions of an environment or a recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mjhab.core.arrays import Array
from mjhab.core.conventions.changes import change_axes, within_half_a_turn
from mjhab.core.conventions.names import WRAPPED, Conventions
from mjhab.core.errors import fault
from mjhab.data.record.targets import state_columns
from mjhab.data.store.older.schemas import OBJECT_POSE
from mjhab.data.store.reading import RecordedEpisode
from mjhab.robots.registry import robot_named

if TYPE_CHECKING:
    from mjhab.envs.parts.worlds import PolicyWorlds

JOINT_POSITIONS = "agent/qpos"


def observed_state(
    env: PolicyWorlds, obs: Mapping[str, Any], conventions: Conventions
) -> Array:
    """State (W, D) float32 of the present observations ``obs`` in the conventions of a student."""
    if Conventions.of(vars(env.config)) == conventions:
        return obs["state"]
    return env.state_as(conventions)


def recorded_state(episode: RecordedEpisode, conventions: Conventions) -> np.ndarray:
    """State (N+1, D) float32 of a recorded episode in the conventions of a student.

    Raises:
        UsageError: the recording lacks what a conversion needs.
    """
    state = episode.array("obs/state")
    have = episode.conventions
    if have == conventions:
        return state
    # The episode may keep its array for the next reader.
    state = state.copy()
    if have.object_axes != conventions.object_axes:
        _turn_object(episode, state, conventions)
    if have.joint_angles != conventions.joint_angles:
        _turn_joints(episode, state, conventions)
    return state


def _turn_object(episode: RecordedEpisode, state: np.ndarray, want: Conventions) -> None:
    """Convert the pose of the object in ``state`` (N+1, D), in place."""
    columns = state_columns(episode, OBJECT_POSE)
    if columns is None:
        return
    yaws = episode.scan_yaws
    if yaws is None:
        raise fault(
            f"episode {episode.name} of {episode.shard.path}",
            "has poses of objects in the axes of the "
            f"{episode.conventions.object_axes} and does not hold the headings of the scans, as runs of older versions "
            f"do not, so it cannot be told in those of the {want.object_axes}. Record it again: mjhab generate",
        )
    state[:, columns] = change_axes(
        state[:, columns], yaws, episode.conventions.object_axes, want.object_axes
    )


def _turn_joints(episode: RecordedEpisode, state: np.ndarray, want: Conventions) -> None:
    """Convert the angles of joints without limits in ``state`` (N+1, D), in place."""
    columns = state_columns(episode, JOINT_POSITIONS)
    robot = robot_named(episode.run.robot)
    endless = robot.endless[robot.columns.upper]
    if columns is None or not any(endless):
        return
    if want.joint_angles == WRAPPED:
        state[:, columns] = within_half_a_turn(state[:, columns], endless)
        return
    if "states/qpos" not in episode.paths:
        raise fault(
            f"episode {episode.name} of {episode.shard.path}",
            "has joint angles within half a turn and no states, so "
            "their turns are not known. Record it with states (mjhab generate without --no-states), or with "
            "joint_angles='unwrapped'.",
        )
    # Only the simulator's own positions count whole turns.
    q = episode.array("states/qpos")[:, episode.run.layout["columns"]["robot_q"]]
    state[:, columns] = q[:, robot.columns.upper]
