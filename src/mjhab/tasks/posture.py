"""How far torso, head and arm are from rest."""

from __future__ import annotations

from mjhab.core.arrays import Array, constant
from mjhab.core.conventions.changes import within_half_a_turn
from mjhab.tasks.thresholds import TaskConfig


def off_rest(robot_q: Array, config: TaskConfig) -> Array:
    """Signed distances (W, P) of the posture's joints from rest [m or rad].

    Args:
        robot_q: (W, J) joint positions [m or rad].
        config: its ``endless`` says of which joints whole turns do not count.
    """
    posture = config.joints.posture
    off = robot_q[:, posture] - constant(config.rest_qpos[posture], robot_q)
    return within_half_a_turn(off, config.endless[posture])
