"""Functions that return the subtasks for one object: the building blocks of household plans."""

from __future__ import annotations

from mjhab.core.errors import missing_field
from mjhab.tasks.plan import GOAL_OF, Subtask, SubtaskKind, Target


def pick_and_place(target: Target) -> list[Subtask]:
    """Subtasks Navigate, Pick, Navigate, Place for one object."""
    kind = SubtaskKind
    return [
        Subtask(
            kind.NAVIGATE,
            link=target.start_link,
            goal_pos=target.start_pos,
            toward=target.obj,
        ),
        Subtask(kind.PICK, obj=target.obj, link=target.start_link),
        Subtask(
            kind.NAVIGATE,
            target.obj,
            target.goal_link,
            target.goal_pos,
            must_hold=True,
            # The goal and not the object, which is in the hand by then.
            toward=f"{GOAL_OF}{target.obj}",
        ),
        Subtask(
            kind.PLACE, obj=target.obj, link=target.goal_link, goal_pos=target.goal_pos
        ),
    ]


def open_start(target: Target) -> list[Subtask]:
    """`pick_and_place` for an object in a drawer or behind a door, which the plan opens before and closes after.

    Raises:
        UsageError: the object does not start in a drawer or behind a door.
    """
    return _opened(target, target.start_link, "start_link")


def open_goal(target: Target) -> list[Subtask]:
    """`pick_and_place` to a goal in a drawer or behind a door, which the plan opens before and closes after.

    Raises:
        UsageError: the goal is not in a drawer or behind a door.
    """
    return _opened(target, target.goal_link, "goal_link")


def _opened(target: Target, link: str, which: str) -> list[Subtask]:
    if not link:
        raise missing_field(
            which,
            f"target {target.obj!r}",
            "The plan needs the drawer or door that it opens.",
        )
    kind = SubtaskKind
    handle = target.handle_pos
    go = Subtask(kind.NAVIGATE, link=link, goal_pos=handle, toward=link)
    opening = Subtask(kind.OPEN, obj=target.obj, link=link, goal_pos=handle)
    closing = Subtask(kind.CLOSE, link=link, goal_pos=handle)
    # The robot drives back before it closes, because the object was put elsewhere.
    return [go, opening, *pick_and_place(target), go, closing]
