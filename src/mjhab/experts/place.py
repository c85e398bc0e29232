"""The expert that places objects."""

from __future__ import annotations

from mjhab.envs.privileged import WorldView
from mjhab.experts import motion
from mjhab.experts.motion import Motion


def place(view: WorldView) -> Motion:
    """Script of a place subtask."""
    return (yield from motion.stay_at_rest(view, gripper=motion.CLOSED))
