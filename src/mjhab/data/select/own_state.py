"""The state observations of a recorded episode, divided by who can know them: the robot, or the simulation alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.core.joints import BASE, BASE_XY, BASE_YAW
from mjhab.data.store.reading import Episode

BASE_VELOCITY = "agent/base_vel"
OWN_KEYS: tuple[str, ...] = (
    "agent/qpos",
    "agent/qvel",
    BASE_VELOCITY,
    "extra/tcp_pose_wrt_base",
)
"""Observations that a robot has by its own sensors (proprioception), in the order of the mode "proprioception"."""


@dataclass(frozen=True)
class SplitState:
    """State observations (N+1, n) float32 by key. ``own``: of OWN_KEYS; ``task``: object, goal, grasp and the like."""

    own: dict[str, np.ndarray]
    task: dict[str, np.ndarray]


def split_state(episode: Episode) -> SplitState:
    """Divide the state observations of an episode.

    The velocity of the base is computed from the recorded states where the observations lack it, and left out where
    the episode has no states.
    """
    parts = {key: values.reshape(len(values), -1) for key, values in _parts(episode).items()}
    if BASE_VELOCITY not in parts and "states/qvel" in episode.paths:
        parts[BASE_VELOCITY] = base_velocity(episode)
    own = {key: parts[key] for key in OWN_KEYS if key in parts}
    return SplitState(own, {key: values for key, values in parts.items() if key not in own})


def _parts(episode: Episode) -> dict[str, np.ndarray]:
    """The named parts of ``obs/state``; all of it under its own name where the parts have none."""
    return episode.table("obs/state") or {"state": episode.array("obs/state")}


def base_velocity(episode: Episode) -> np.ndarray:
    """(N+1, 3) float32 velocity of the base in its own frame: forward, to the left [m/s], yaw rate [rad/s]."""
    columns = episode.run.layout["columns"]
    q = episode.array("states/qpos")[:, columns["robot_q"][BASE]]
    qd = episode.array("states/qvel")[:, columns["robot_v"][BASE]]
    c = np.cos(q[:, BASE_YAW])
    s = np.sin(q[:, BASE_YAW])
    x, y = qd[:, BASE_XY].T
    return np.stack([c * x + s * y, c * y - s * x, qd[:, BASE_YAW]], axis=1).astype(np.float32)
