"""The expert that picks objects."""

from __future__ import annotations

from mjhab.envs.privileged import WorldView
from mjhab.experts import motion
from mjhab.experts.motion import Motion


def pick(view: WorldView) -> Motion:
    """Script of a pick subtask."""
    return (yield from motion.stay_at_rest(view, gripper=motion.OPEN))
