"""The state observations of a recorded episode, divided into proprioception and privileged state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.core.joints import BASE, BASE_XY, BASE_YAW
from mjhab.data.store.reading import RecordedEpisode

BASE_VELOCITY = "agent/base_vel"
OWN_KEYS: tuple[str, ...] = (
    "agent/qpos",
    "agent/qvel",
    BASE_VELOCITY,
    "extra/tcp_pose_wrt_base",
)
"""Observations from the robot's own sensors, in the order of the observation mode "proprioception"."""


@dataclass(frozen=True)
class SplitState:
    """State observations (N+1, n) float32 by key. own: those of OWN_KEYS. task: object, goal, grasp and others."""

    own: dict[str, np.ndarray]
    task: dict[str, np.ndarray]


def split_state(episode: RecordedEpisode) -> SplitState:
    """Divide the state observations of an episode.

    If the observations lack the velocity of the base, it is computed from the recorded states; without states it is
    left out.
    """
    parts = {
        key: values.reshape(len(values), -1) for key, values in _parts(episode).items()
    }
    if BASE_VELOCITY not in parts and tells_base_velocity(episode):
        parts[BASE_VELOCITY] = base_velocity(episode)
    own = {key: parts[key] for key in OWN_KEYS if key in parts}
    return SplitState(
        own, {key: values for key, values in parts.items() if key not in own}
    )


def _parts(episode: RecordedEpisode) -> dict[str, np.ndarray]:
    """The named parts of ``obs/state``; all of it as "state" if the parts have no names."""
    return episode.table("obs/state") or {"state": episode.array("obs/state")}


def tells_base_velocity(episode: RecordedEpisode) -> bool:
    """Whether an episode has what `base_velocity` computes; what was imported has no states."""
    return "states/qvel" in episode.paths


def base_velocity(episode: RecordedEpisode) -> np.ndarray:
    """Velocity of the base in its own frame (N+1, 3) float32: forward, left [m/s], yaw rate [rad/s]."""
    columns = episode.run.layout["columns"]
    q = episode.array("states/qpos")[:, columns["robot_q"][BASE]]
    qd = episode.array("states/qvel")[:, columns["robot_v"][BASE]]
    c = np.cos(q[:, BASE_YAW])
    s = np.sin(q[:, BASE_YAW])
    x, y = qd[:, BASE_XY].T
    # The joints of the base move along the axes of the world.
    return np.stack([c * x + s * y, c * y - s * x, qd[:, BASE_YAW]], axis=1).astype(
        np.float32
    )
