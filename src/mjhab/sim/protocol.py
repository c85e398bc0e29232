"""The interface of a simulator that environments use, the same for all physics engines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from mjhab.layout.addresses import Addresses
from mjhab.layout.layout import Layout

TAINTS = (
    "contact_overflow",
    "constraint_overflow",
    "nan",
    "engine_warning",
    "penetration",
)
"""Names of the bits of a world's taint mask, lowest first.

A tainted world has had an event since its reset that makes its physics unreliable: a contact or constraint buffer that
overflowed, NaN or infinite values, an engine warning, or a robot contact deeper than PENETRATION_LIMIT.
"""
PENETRATION_LIMIT = 0.02
"""A contact of the robot with a penetration depth above this [m] taints the world."""


@dataclass(frozen=True, eq=False)
class SimState:
    """State of all worlds after a control step.

    Letters: W worlds, J robot joints, N object slots, L moving links of furniture (drawers and doors), K robot links
    of `Robot.force_links`, B bodies of the model. A target is an object or a moving link: N + L of them, objects first.
    Contact forces are normal forces without friction, of the last substep. Arrays may be views that the next step
    overwrites.

    Attributes:
        robot_q: (W, J) positions of the robot's joints, in the order of `Robot.joints` [m or rad].
        robot_qd: (W, J) their velocities [m/s or rad/s].
        object_pose: (W, N, 7) pose in the world frame [m, wxyz].
        object_vel: (W, N, 6) velocity of the origin in the world frame [m/s], then angular velocity in the object's
            own frame [rad/s].
        link_q: (W, L) joint positions of the moving links [m or rad].
        link_qd: (W, L) their velocities [m/s or rad/s].
        tcp_vel: (W, 3) velocity of the tcp in the world frame [m/s].
        link_force: (W, K) norm of the net contact force on each force link [N].
        finger_force: (W, 2, N + L, 3) force of each target on the [left, right] finger, world frame [N].
        finger_net: (W, 2) norm of the net contact force on the [left, right] finger, by whatever it touches [N].
        touch: (W, N + L) bool: some robot link has a contact with the target.
        ee_contact: (W, N + L) bool: a finger or the hand has one.
        body_pos: (W, B, 3) body positions in the world frame [m].
        body_mat: (W, B, 3, 3) body rotations in the world frame.
        body_quat: (W, B, 4) the same as quaternions, wxyz.
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
    finger_net: Any
    touch: Any
    ee_contact: Any
    body_pos: Any
    body_mat: Any
    body_quat: Any


class Simulator(Protocol):
    """A batch of worlds of one layout: all are stepped together, each can be reset on its own.

    Attributes:
        layout: names, order and sizes shared by all homes.
        addresses: indices of joints, bodies and sensors in the models of the layout.
        num_worlds: W.
        num_threads: CPU threads that step the worlds.
    """

    layout: Layout
    addresses: Addresses
    num_worlds: int
    num_threads: int

    def reset(self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray) -> None:
        """Reset worlds ``ids`` to the states ``qpos`` (n, nq) of ``homes`` with zero velocity.

        Time, warm start and taint of these worlds are cleared; all other worlds stay bitwise the same.
        """
        ...

    def mend(self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray) -> None:
        """Reset worlds that became NaN or infinite as `reset` does, but keep their taint."""
        ...

    def write_qpos(self, world: int, qpos: np.ndarray) -> None:
        """Teleport one world to ``qpos`` (nq,) in its present home.

        The velocities of the robot and of every object that moves become zero.
        """
        ...

    def step(self, ctrl: np.ndarray) -> None:
        """Advance all worlds by one control step (5 substeps of 10 ms) under ``ctrl`` (W, nu)."""
        ...

    def state(self) -> SimState:
        """Return the current state of all worlds."""
        ...

    def get_world(self, world: int) -> dict[str, np.ndarray]:
        """Return copies of the full physics state of one world: "time", "qpos", "qvel", "ctrl", "warmstart"."""
        ...

    def set_world(self, world: int, home: str, saved: Mapping[str, np.ndarray]) -> None:
        """Restore one world in a home from a state of `get_world`, and clear its taint."""
        ...

    def broken(self) -> np.ndarray:
        """Return (W,) bool: worlds that became NaN or infinite in the last step, or that the engine reset for it.

        The state of such a world is meaningless until `mend`.
        """
        ...

    def add_taint(self, world: int, mask: int) -> None:
        """Set the bits ``mask`` in the taint of a world, e.g. those it had when the restored state was saved."""
        ...

    def taint(self) -> np.ndarray:
        """Return (W,) uint8: bit mask of the TAINTS of each world since its reset."""
        ...
