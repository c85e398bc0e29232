"""Object rosters: the object type of every object slot in the episodes of a task."""

from __future__ import annotations

from mjhab.config.env import EnvConfig
from mjhab.scenes.builtin.objects import CLUTTER_TYPES
from mjhab.scenes.spec import Pack
from mjhab.tasks.household.registry import TASKS


def roster(task: str) -> tuple[str, ...]:
    """Return the object type of every slot of a task's generated episodes: clutter first, then the task's own objects.

    HAB's counts: 30 objects in TidyHouse and PrepareGroceries; SetTable has 27 clutter objects, a bowl and an apple.

    Raises:
        UsageError: there is no such task.
    """
    spec = TASKS[task]
    clutter = tuple(name for name in CLUTTER_TYPES for _ in range(spec.clutter_copies))
    return clutter + spec.objects


def object_roster(config: EnvConfig, pack: Pack) -> tuple[str, ...]:
    """Return the object type of every slot of an environment: task, ``extra_objects``, then a target in neither.

    Args:
        config: names task, target and extra objects.
        pack: asset pack; a target that is not one of its objects is a link and adds no slot.

    Raises:
        UsageError: there is no such task.
    """
    found = (*roster(config.task), *config.extra_objects)
    target = config.target
    # A target may also be the id of a link, which is no object.
    return (*found, target) if target in pack.objects and target not in found else found
