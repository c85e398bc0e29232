"""The interface of a simulator that environments use, the same for all physics engines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from mjhab.layout.layout import Addresses, Layout

TAINTS = ("contact_overflow", "constraint_overflow", "nan", "engine_warning", "penetration")
"""Names of the bits of a world's taint mask, lowest first."""
PENETRATION_LIMIT = 0.02
"""A contact of the robot deeper than this [m] taints the episode."""


@dataclass(frozen=True, eq=False)
class SimState:
    """State of all worlds after a control step. W worlds, J robot joints, N objects, L links, K force links.

    robot_q, robot_qd (W, J) in the order of the robot's joints [m, rad]; object_pose (W, N, 7) world [m, wxyz];
    object_vel (W, N, 6) velocity of the origin in the world [m/s], then angular velocity in the object's own frame
    [rad/s]; tcp_vel (W, 3) velocity of the tool centre in the world [m/s];
    link_q, link_qd (W, L) [m or rad, per s]; link_force (W, K) norm of the net contact force on each robot link without
    fingers [N];
    finger_force (W, 2, N + L, 3) force by each target (objects, then links) on the [l, r] finger, world frame [N];
    touch (W, N + L) bool: some robot link touches the target; ee_contact (W, N + L) bool: fingers or hand do;
    body_pos (W, B, 3), body_mat (W, B, 3, 3), body_quat
    (W, B, 4) wxyz world.
    Forces are those of the last substep. Arrays may be views that the next step overwrites.
    """

    robot_q: Any
    robot_qd: Any
    object_pose: Any
    object_vel: Any
    tcp_vel: Any
    link_q: Any
    link_qd: Any
    link_force: Any
    finger_force: Any
    touch: Any
    ee_contact: Any
    body_pos: Any
    body_mat: Any
    body_quat: Any


class Simulator(Protocol):
    """A batch of worlds of one layout, stepped together, reset one by one."""

    layout: Layout
    addresses: Addresses
    num_worlds: int
    num_threads: int

    def reset(self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray) -> None:
        """Put worlds into homes at rest in the states ``qpos`` (n, nq); other worlds keep every bit."""
        ...

    def mend(self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray) -> None:
        """Like `reset`, for worlds that broke: they stay tainted."""
        ...

    def write_qpos(self, world: int, qpos: np.ndarray) -> None:
        """Move one world to ``qpos`` (nq,) with zero robot velocity, keeping its home (teleport)."""
        ...

    def step(self, ctrl: np.ndarray) -> None:
        """Advance all worlds by one control step (5 substeps of 10 ms) under ``ctrl`` (W, nu)."""
        ...

    def state(self) -> SimState:
        """The current state of all worlds."""
        ...

    def get_world(self, world: int) -> dict[str, np.ndarray]:
        """Copies of everything the physics of one world depends on: "time", "qpos", "qvel", "ctrl", "warmstart"."""
        ...

    def set_world(self, world: int, home: str, saved: Mapping[str, np.ndarray]) -> None:
        """Put one world into a home in a state from `get_world`, with everything awake."""
        ...

    def broken(self) -> np.ndarray:
        """(W,) bool: worlds that the last step made NaN or infinite, or that the engine put back for it; their state
        means nothing.
        """
        ...

    def add_taint(self, world: int, mask: int) -> None:
        """Mark a world with the bits of ``mask``, as of a state that was tainted before it was restored."""
        ...

    def taint(self) -> np.ndarray:
        """(W,) uint8 bit mask of TAINTS that arose since each world's reset."""
        ...
