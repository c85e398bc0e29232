"""Which objects there are in the episodes of a task."""

from __future__ import annotations

from mjhab.scenes.builtin.objects import CLUTTER_TYPES
from mjhab.tasks.household.registry import TASKS


def roster(task: str) -> tuple[str, ...]:
    """Object type of every slot that a task's generated episodes use, in slot order: clutter, then its own objects.

    HAB's counts: 30 objects in TidyHouse and PrepareGroceries; SetTable has 27 clutter objects, a bowl and an apple.

    Raises:
        UsageError: there is no such task.
    """
    spec = TASKS[task]
    clutter = tuple(name for name in CLUTTER_TYPES for _ in range(spec.clutter_copies))
    return clutter + spec.objects
