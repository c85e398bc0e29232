"""Which objects there are in the episodes of a task: one type per object slot."""

from __future__ import annotations

from mjhab.config.env import EnvConfig
from mjhab.scenes.builtin.objects import CLUTTER_TYPES
from mjhab.scenes.spec import Pack
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


def object_roster(config: EnvConfig, pack: Pack) -> tuple[str, ...]:
    """Object type of every slot of an environment: those of its task, ``extra_objects``, and a target in neither.

    Args:
        config: names task, target and extra objects.
        pack: has the objects; a target that it does not have is no object (a link), and adds nothing.

    Raises:
        UsageError: there is no such task.
    """
    found = (*roster(config.task), *config.extra_objects)
    target = config.target
    return (*found, target) if target in pack.objects and target not in found else found
