"""Scripts of the subtasks Open and Close, for drawers and for hinged doors."""

from __future__ import annotations

from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import motion
from mjhab.experts.skills.doors.closing import close_door
from mjhab.experts.skills.doors.opening import open_door
from mjhab.experts.skills.drawer import close_drawer, open_drawer

Motion = motion.Motion


def open_link(view: WorldView) -> Motion:
    """Open the link of the active subtask, then stay at rest."""
    subtask = view.subtask
    assert subtask is not None
    link = view.home.links[subtask.link]
    yield from (
        open_drawer(view, link) if link.spec.joint == "slide" else open_door(view, link)
    )
    return (yield from motion.stay_at_rest(view, gripper=motion.OPEN))


def close_link(view: WorldView) -> Motion:
    """Close the link of the active subtask, then stay at rest."""
    subtask = view.subtask
    assert subtask is not None
    link = view.home.links[subtask.link]
    yield from (
        close_drawer(view, link) if link.spec.joint == "slide" else close_door(view, link)
    )
    return (yield from motion.stay_at_rest(view, gripper=motion.OPEN))
