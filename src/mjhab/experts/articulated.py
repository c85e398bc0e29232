"""Experts that open and close drawers and doors."""

from __future__ import annotations

from mjhab.envs.privileged import WorldView
from mjhab.experts import motion


def open_link(view: WorldView) -> motion.Motion:
    """Open the active subtask's link."""
    return (yield from motion.stay_at_rest(view, gripper=motion.OPEN))


def close_link(view: WorldView) -> motion.Motion:
    """Close the active subtask's link."""
    return (yield from motion.stay_at_rest(view, gripper=motion.OPEN))
