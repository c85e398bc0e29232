"""The state that simulators give, and the events that make physics unreliable: the same for all physics engines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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
